"""
The record streams of a run directory: which there are, and what one pass over each finds.

Reading itself is the recorder's own reader (`madns_runtime.recording.reader`). What cannot be read is
counted, never guessed.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal, get_args

import numpy as np
import orjson
from numpy.typing import NDArray

from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.errors import MachineError
from madns_runtime.recording.reader import StreamReading, read_stream
from madns_runtime.recording.records import (
    FRAMEWORK_SCHEMAS,
    NUMBER_KINDS,
    SCHEMA_VERSION,
    Field,
    StreamSchema,
)
from madns_runtime.recording.stream_rules import DETAILS as DETAILS_NAME

SUFFIX = ".jsonl"
INCARNATION = re.compile(r"[1-9][0-9]{0,4}")
"""In a file's name; what bears another number, to which no recorder counts, is a stream of that name."""
INCARNATION_MAX = 99_999
DETAILS = Field(DETAILS_NAME, "", "json")
"""Column of what events carry beside their fields."""
Role = Literal["host", "agent", "machine", "device"]
Kind = Literal["float", "int", "str", "bool", "json", "packed"]
Columns = dict[str, NDArray[Any]]
Consumer = Callable[[Columns, int, int], None]
"""Takes a batch by columns, its number of records, and of how many bytes of the file it was read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordFile:
    """One file of one stream: who recorded it, in which incarnation of the process, and its fields."""

    path: Path
    role: Role
    source: str
    """host, an agent's or a machine's name, or a device's full name such as pi22/imu."""
    stream: str
    incarnation: int
    fields: tuple[Field, ...]
    """Empty when the schema line is missing or damaged, or tells of something else."""
    is_array: bool = True
    schema: int = SCHEMA_VERSION
    """Version of how it is written."""
    stray: str = ""
    """Name of their source by their schema line, where that is not what the file's place says."""

    @property
    def table(self) -> str:
        """Name of the table that this stream's records go into."""
        if self.role == "device":  # a name per device: kinds may share names of channels
            return f"device_{PurePosixPath(self.source).name}.{self.stream}"
        return self.stream if self.role == "agent" else f"{self.role}_{self.stream}"

    @property
    def label(self) -> str:
        """The stream as a person is told about it, such as agent-03/ticks."""
        which = f" (incarnation {self.incarnation})" if self.incarnation > 1 else ""
        return f"{self.source}/{self.stream}{which}"


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamScan:
    """Result of one pass over a file."""

    file: RecordFile
    size_bytes: int
    sha256: str
    records: int = 0
    damaged: int = 0
    """Lines that are no record of this schema, a cut last line among them."""
    promised: int | None = None
    """Records that the end line counts; None without an end line: the stream was cut."""
    dropped: int = 0
    """Records that the recorder could not hold, as the end line counts them."""
    not_finite: int = 0
    """Values that were NaN or infinite and are null, as the end line counts them."""

    @property
    def truncated(self) -> bool:
        """Whether the file was cut, damaged, or holds fewer records than its end line counts."""
        return self.promised is None or self.damaged > 0 or self.records != self.promised

    @property
    def lost(self) -> int:
        """Records known to be lost: dropped, damaged, or counted and not there."""
        absent = max((self.promised or 0) - self.records, 0)
        return self.dropped + max(absent, self.damaged)

    @property
    def fault(self) -> str | None:
        """Say what is wrong with the stream; None if all of it is there."""
        if self.size_bytes == 0:
            return "empty file: nothing reached the disk"
        if self.file.schema > SCHEMA_VERSION:
            known = f"this one knows {SCHEMA_VERSION}"
            return f"schema {self.file.schema} is of a newer COSMoS, {known}: upgrade cosmos-madns"
        if self.file.stray:
            return f"holds records of {self.file.stray}, which do not belong here"
        if not self.file.fields:
            return "the schema line is missing or damaged"
        if self.promised is None:
            return f"cut after {self.records} records"
        if self.damaged:
            return f"{self.damaged} damaged line(s)"
        if self.records != self.promised:
            return f"{self.records} records where its end line counts {self.promised}"
        if self.dropped:
            had = "had no room in recording.buffer_bytes or on the disk"
            return f"{self.dropped} records were dropped while recording: they {had}"
        return None


def find_streams(run_path: Path, runs: Collection[str] = ()) -> list[RecordFile]:
    """
    Return every stream file of a run: host first, then agents, machines and devices, each in order.

    Links are no records: they would be read and not packaged.

    Args:
        run_path: The run's directory, which may have been renamed.
        runs: By what names its schema lines may call the run; empty for any.
    """
    places: list[tuple[Role, str]] = [
        ("host", "host"),
        ("agent", "agents/*"),
        ("machine", "machines/*"),
        ("device", "devices/*/*"),
    ]
    found = [
        open_stream_file(path, role, runs)
        for role, folder in places
        for path in run_path.glob(f"{folder}/*{SUFFIX}")
        if os.path.isfile(path) and not is_linked(path, run_path)
    ]
    return sorted(found, key=_order)


def file_size_bytes(path: Path) -> int:
    """Return the bytes of a file; 0 where it is gone or cannot be looked at."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def is_linked(path: Path, run_path: Path) -> bool:
    """Tell whether a file, or a folder between it and the run's, is a link."""
    inner = itertools.takewhile(lambda folder: folder != run_path, path.parents)
    return path.is_symlink() or any(folder.is_symlink() for folder in inner)


def open_stream_file(path: Path, role: Role, runs: Collection[str] = ()) -> RecordFile:
    """Read a stream's name and schema line; of one that cannot be read, or is of none of *runs*, the fields are empty."""
    stem = path.name.removesuffix(SUFFIX)
    name, dot, number = stem.rpartition(".")
    is_later = bool(dot) and INCARNATION.fullmatch(number) is not None
    try:
        schema: Mapping[str, Any] = read_stream(path).schema
    except MachineError:
        schema = {}
    source = path.parent.name
    if role == "device":
        source = f"{path.parent.parent.name}/{source}"
    stream = name if is_later else stem
    own = FRAMEWORK_SCHEMAS.get(stream) if role != "device" else None  # a channel may bear any name
    stray = _stray(schema, source, stream, runs)
    return RecordFile(
        path=path,
        role=role,
        source=source,
        stream=stream,
        stray=stray,
        incarnation=int(number) if is_later else 1,
        fields=() if stray else _fields(schema, own),
        is_array=schema.get("shape") == "array",
        schema=version if isinstance(version := schema.get("schema"), int) else SCHEMA_VERSION,
    )


def scan_stream(file: RecordFile, consume: Consumer | None = None) -> StreamScan:
    """
    Read a whole stream, once: hashed, counted, and given to *consume*.

    Args:
        file: The stream.
        consume: Called with each batch of records, one block of the file.

    Raises:
        MachineError: The file cannot be read.
    """
    hashed = _Hashed()
    reading = StreamReading(file.path, hashed.take)
    try:
        if file.fields:
            passed_bytes = 0
            for columns, count in read_batches(file, reading):
                if consume is not None:
                    consume(columns, count, hashed.size_bytes - passed_bytes)
                passed_bytes = hashed.size_bytes
        state = reading.state
    except OSError as error:
        raise MachineError(f"{file.path}: cannot be read: {error.strerror}") from error
    return StreamScan(
        file=file,
        size_bytes=hashed.size_bytes,
        sha256=hashed.digest.hexdigest(),
        records=state.records,
        damaged=state.damaged + state.truncated_lines,
        promised=None if state.is_cut else state.recorded,
        dropped=state.dropped,
        not_finite=state.not_finite,
    )


class _Hashed:
    """Size and hash of the bytes that were read."""

    def __init__(self) -> None:
        self.size_bytes = 0
        self.digest = hashlib.sha256()

    def take(self, data: bytes) -> None:
        self.size_bytes += len(data)
        self.digest.update(data)


def read_batches(file: RecordFile, reading: StreamReading) -> Iterator[tuple[Columns, int]]:
    """Give the records block by block, by columns, with their number."""
    if file.is_array:
        for columns in reading.column_chunks():
            yield columns, len(columns[file.fields[0].name])
        return
    names = [field.name for field in file.fields]
    for records in reading.chunks():
        columns = {name: _objects([r.get(name) for r in records]) for name in names}
        details = _objects([_details(record, names) for record in records])
        # A field of that name, which earlier versions let be recorded, is not put aside for what stands beside it.
        yield {DETAILS.name: details, **columns}, len(records)


def _details(record: Mapping[str, Any], names: Sequence[str]) -> str | dict[str, Any] | None:
    """Return as JSON what a record carries beside its fields; as it is where it is nested deeper than orjson writes."""
    rest = {key: value for key, value in record.items() if key not in names}
    try:
        return orjson.dumps(rest).decode() if rest else None
    except TypeError:
        return rest


def _objects(values: list[Any]) -> NDArray[Any]:
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column


def _stray(schema: Mapping[str, Any], source: str, stream: str, runs: Collection[str]) -> str:
    """Return whose records a schema line tells of if not of these: copied from elsewhere, they would be taken for them."""
    told = {key: schema.get(key) for key in ("source", "stream", "run")}
    named = {key: name for key, name in told.items() if isinstance(name, str)}
    is_own = named.get("source", source) == source and named.get("stream", stream) == stream
    of_run = named.get("run")
    is_of_run = of_run is None or not runs or of_run in runs
    if is_own and is_of_run:
        return ""
    whose = f"{named.get('source', source)}/{named.get('stream', stream)}"
    return clean_line(whose if is_of_run else f"{whose} of run {of_run}")


def _fields(schema: Mapping[str, Any], own: StreamSchema | None) -> tuple[Field, ...]:
    """Return the fields of a schema line; none where it has text for numbers of the framework's *own*, or the reverse."""
    try:
        fields = tuple(
            Field(str(f["name"]), str(f.get("unit", "")), _kind(f.get("kind")))
            for f in schema.get("fields", ())
        )
    except (KeyError, TypeError, AttributeError):
        return ()
    is_number = {f.name: f.kind in NUMBER_KINDS for f in own.fields} if own else {}
    fit = (is_number.get(f.name) in (None, f.kind in NUMBER_KINDS) for f in fields)
    return fields if all(fit) else ()


def _kind(value: object) -> Kind:
    kinds: tuple[Kind, ...] = get_args(Kind)
    return next((kind for kind in kinds if kind == value), "json")


def _order(file: RecordFile) -> tuple[int, str, str, int]:
    return (get_args(Role).index(file.role), file.stream, file.source, file.incarnation)
