"""
Record streams read back: whole ones, cut ones and damaged ones, in bounded memory.

A file is read in blocks of whole lines that are decoded at a stroke; only a block that does not decode,
or holds lines that are no records, is taken line by line.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import orjson

from madns_runtime.bounded_files import open_regular_file
from madns_runtime.errors import MachineError
from madns_runtime.recording.columns import Columns, column_of, joined_column
from madns_runtime.recording.records import WHOLE_MAX
from madns_runtime.recording.stream_rules import CONTROL_KEYS

BLOCK_BYTES = 1 << 17
"""Small enough that its text and values stay in the processor's cache: eight times as much took twice the time."""
LINE_BYTES_MAX = 64 << 20
"""A longer line is none of ours; it is skipped and counted as damaged."""
END_COUNTS = ("records", "dropped", "not_finite")
_COMMA = ord(",")
_NEWLINE = ord("\n")


@dataclass(slots=True, kw_only=True)
class StreamState:
    """Result of a pass over the file."""

    records: int = 0
    is_cut: bool = True
    """No end line: the process that recorded did not close the stream."""
    truncated_lines: int = 0
    """1 if the last line is cut or does not decode; it is skipped."""
    damaged: int = 0
    """Lines before the last that do not decode or have the wrong number of values; they are skipped."""
    dropped: int = 0
    """Number of records that the recorder itself gave up, by the end line."""
    not_finite: int = 0
    """Values that were NaN or infinite and are null here, by the end line."""
    recorded: int | None = None
    """Records in the file by the end line; None where it is cut."""
    t0_utc: str | None = None


class StreamReading:
    """
    One stream's file, read as often as asked.

    Args:
        path: The file.
        take: Called with all bytes of the file, in order, as a pass over it reads them: a hash needs no pass
            of its own.

    Raises:
        MachineError: The file cannot be opened, or is none: a pipe is waited for without end.
    """

    def __init__(self, path: Path, take: Callable[[bytes], None] | None = None) -> None:
        self.path = path
        self._take = take or (lambda data: None)
        with _open(path) as file:
            first = file.readline(LINE_BYTES_MAX)
        header = _decode(first)
        self.schema: Mapping[str, Any] = header if _is_header(header) else {}
        """Line 1; empty if the file has none."""
        self._first_bytes = len(first) if self.schema else 0
        self._state: StreamState | None = None
        self.passed = StreamState()
        """Result so far of the newest pass over the records, which need not have come to the end."""

    @property
    def state(self) -> StreamState:
        """Result of a whole pass; makes that pass if there was none."""
        if self._state is None:
            for _ in self.chunks():
                pass
        return self._state or StreamState()

    @property
    def is_array(self) -> bool:
        """Whether records are arrays (else objects)."""
        return self.schema.get("shape") == "array"

    @property
    def kinds(self) -> dict[str, str]:
        """Kinds of the fields by their names, in order."""
        return {field["name"]: field["kind"] for field in self.schema.get("fields", ())}

    @property
    def field_names(self) -> tuple[str, ...]:
        """Names of the fields, in order."""
        return tuple(field["name"] for field in self.schema.get("fields", ()))

    def records(self) -> Iterator[Any]:
        """Give every record: a list for an array stream, a mapping for an object stream."""
        for chunk in self.chunks():
            yield from chunk

    def chunks(self) -> Iterator[list[Any]]:
        """Give the records in lists of what one block of the file holds."""
        decoder = _Decoder(self.schema)
        self.passed = decoder.state
        for block, is_last in self._blocks():
            yield decoder.decode(block, is_last=is_last)
        self._state = decoder.state

    def column_chunks(self) -> Iterator[Columns]:
        """Give the columns of each block, as `read_columns` does of the file."""
        decoder, kinds = _Decoder(self.schema), self.kinds
        for block, is_last in self._blocks():
            flat = decoder.decode_numbers(block)
            if flat is not None:
                width = decoder.width
                raw = {name: flat[index::width] for index, name in enumerate(kinds)}
            else:
                rows = decoder.decode(block, is_last=is_last)
                raw = _transpose(rows, tuple(kinds), is_array=self.is_array)
            yield {name: column_of(values, kinds[name]) for name, values in raw.items()}
        self._state = decoder.state

    def _blocks(self) -> Iterator[tuple[bytes, bool]]:
        """Give whole lines in blocks and whether the block is the file's last; that one may lack its newline."""
        with _open(self.path) as file:
            self._take(file.read(self._first_bytes))
            held = b""
            for block in _whole_lines(file, self._take):
                if held:
                    yield held, False
                held = block
            if held:
                yield held, True


def read_stream(path: Path) -> StreamReading:
    """
    Open a stream's file for reading.

    Raises:
        MachineError: The file cannot be opened.
    """
    return StreamReading(path)


def read_columns(path: Path) -> Columns:
    """
    Return a stream by columns: field name -> array, shape (records,).

    Kinds are those of `column_of`; a field that a record lacks is None. Lines that are cut or damaged are
    skipped; `read_stream(path).state` counts them.

    Raises:
        MachineError: The file cannot be opened.
    """
    reading = StreamReading(path)
    chunks = list(reading.column_chunks())
    return {
        name: joined_column([chunk[name] for chunk in chunks]) if chunks else column_of([], kind)
        for name, kind in reading.kinds.items()
    }


class _Decoder:
    """Turns blocks of lines into records and keeps count."""

    def __init__(self, schema: Mapping[str, Any]) -> None:
        fields = schema.get("fields", ())
        self.width = len(fields)
        self._type: type = list if schema.get("shape") == "array" else dict
        self._is_numeric = (
            self._type is list
            and self.width > 0
            and all(field["kind"] in ("float", "int") for field in fields)
        )
        self._is_readable = bool(schema)
        self.state = StreamState(t0_utc=schema.get("t0_utc"))

    def decode(self, block: bytes, *, is_last: bool) -> list[Any]:
        """Return the block's records; broken lines are counted and skipped."""
        rows = self._decode_whole(block)
        if rows is None:
            rows = self._decode_lines(block, is_last=is_last)
        self.state.records += len(rows)
        return rows

    def decode_numbers(self, block: bytes) -> list[float | int | None] | None:
        """Return all numbers of a block one after the other, None if it has to be decoded in full."""
        if not self._is_numeric or not block.startswith(b"[") or not block.endswith(b"]\n"):
            return None
        octets = np.frombuffer(block, np.uint8)
        line_ends = np.flatnonzero(octets == _NEWLINE)
        commas = np.searchsorted(np.flatnonzero(octets == _COMMA), line_ends)
        if not np.array_equal(commas, np.arange(1, len(line_ends) + 1) * (self.width - 1)):
            return None
        joints = block.count(b"]\n[")
        if joints != len(line_ends) - 1 or block.count(b"[") != joints + 1:
            return None
        try:
            numbers: list[float | int | None] = orjson.loads(block.replace(b"]\n[", b","))
        except orjson.JSONDecodeError:
            return None
        if len(numbers) != self.width * len(line_ends):
            return None
        self.state.records += len(line_ends)
        return numbers

    def _decode_whole(self, block: bytes) -> list[Any] | None:
        if self._type is dict or b"\n{" in block or not block.endswith(b"\n"):
            # Objects may be lines of another kind, which only a look at each can tell.
            return None
        try:
            rows = orjson.loads(b"[" + block[:-1].replace(b"\n", b",") + b"]")
        except orjson.JSONDecodeError:
            return None
        width = self.width
        is_whole = len(rows) == block.count(b"\n") and all(
            type(row) is list and len(row) == width for row in rows
        )
        return rows if is_whole else None

    def _decode_lines(self, block: bytes, *, is_last: bool) -> list[Any]:
        lines = block.removesuffix(b"\n").split(b"\n")
        rows = []
        for index, line in enumerate(lines):
            value = _decode(line)
            if self._is_record(value):
                rows.append(value)
            elif not self._take_control(value):
                is_cut = is_last and index == len(lines) - 1
                self.state.truncated_lines += is_cut
                self.state.damaged += not is_cut
        return rows

    def _is_record(self, value: Any) -> bool:
        if self._type is list:
            return isinstance(value, list) and len(value) == self.width
        return self._is_readable and isinstance(value, dict) and not _is_control(value)

    def _take_control(self, value: Any) -> bool:
        if not _is_control(value):
            return False
        if "t0_utc" in value:
            self.state.t0_utc = value["t0_utc"]
            return True
        end = value["end"]
        counts: list[Any] = [end.get(name) for name in END_COUNTS] if isinstance(end, dict) else []
        if not counts or not all(map(_is_count, counts)):
            return False
        self.state.recorded, self.state.dropped, self.state.not_finite = counts
        self.state.is_cut = False
        return True


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= WHOLE_MAX


def _whole_lines(file: BinaryIO, take: Callable[[bytes], None]) -> Iterator[bytes]:
    """Give blocks that end with a newline; the file's last may lack it, a line over the limit is shortened."""
    held: list[bytes] = []
    held_bytes = 0
    while block := file.read(BLOCK_BYTES):
        take(block)
        end = block.rfind(b"\n") + 1
        if end:
            yield b"".join((*held, block[:end]))
            held, held_bytes = [block[end:]], len(block) - end
        elif held_bytes < LINE_BYTES_MAX:
            held.append(block)
            held_bytes += len(block)
    if held_bytes:
        yield b"".join(held)


def _open(path: Path) -> BinaryIO:
    try:
        return os.fdopen(open_regular_file(path), "rb")
    except OSError as error:
        raise MachineError(f"{path}: cannot be read: {error.strerror}") from error


def _decode(line: bytes) -> Any:
    try:
        return orjson.loads(line)
    except orjson.JSONDecodeError:
        return None


def _is_header(value: Any) -> bool:
    if not isinstance(value, dict) or not {"schema", "stream", "shape", "fields"} <= value.keys():
        return False
    fields = value["fields"]
    if not isinstance(fields, list) or not all(_is_field(field) for field in fields):
        return False
    # A record's values are told apart by their names.
    return len({field["name"] for field in fields}) == len(fields)


def _is_field(value: Any) -> bool:
    return isinstance(value, dict) and "kind" in value and isinstance(value.get("name"), str)


def _is_control(value: Any) -> bool:
    return isinstance(value, dict) and len(value) == 1 and next(iter(value)) in CONTROL_KEYS


def _transpose(rows: list[Any], names: tuple[str, ...], *, is_array: bool) -> dict[str, list[Any]]:
    if is_array:
        columns = zip(*rows, strict=True) if rows else ((),) * len(names)
        return {name: list(column) for name, column in zip(names, columns, strict=True)}
    return {name: [row.get(name) for row in rows] for name in names}
