"""
One stream's file: joined lines go out in plain write calls, and a partial write is continued, never repeated.

No buffer of Python's lies between: what a write call took survives kill -9. Two threads share an
object: the loop appends to `lines` and owns `overflowed` and `not_finite`; the writer thread owns the
rest. Under that rule no lock is needed: appending to a list and cutting off its head are each atomic.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.recording.number_rows import NumberRows
from madns_runtime.recording.records import StreamSchema

LINES_PER_WRITE_MAX = 1024
LINE_OVERHEAD_BYTES = 56
"""Bytes that a waiting line costs beside its text: the bytes object and its place in the list."""
FILES_MAX = 10_000
NO_DESCRIPTOR_CURE = (
    "; `ulimit -Hn` tells how many files a process may have open here, and each agent takes one per stream:"
    " raise it, or lower agents.per_process"
)


def create_file(directory: Path, name: str, first: int) -> tuple[Path, int, int]:
    """
    Create the stream's file under the first name that is still free.

    Args:
        directory: Where to.
        name: The stream's.
        first: The number to begin with; 1 is <name>.jsonl, 2 is <name>.2.jsonl.

    Returns:
        The file's path, its descriptor, and the number that it got.

    Raises:
        MachineError: The directory takes no new file.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
    for number in range(first, first + FILES_MAX):
        path = path_of(directory, name, number)
        try:
            return path, os.open(path, flags, 0o644), number
        except FileExistsError:
            continue
        except OSError as error:
            cure = NO_DESCRIPTOR_CURE if error.errno == errno.EMFILE else ""
            raise MachineError(f"{path}: cannot record there: {error.strerror}{cure}") from error
    raise MachineError(f"{directory}: holds {FILES_MAX} files of stream {name}; clear it out")


def path_of(directory: Path, name: str, number: int) -> Path:
    """Return the file of a stream that bears a number; that of the first has none in its name."""
    return directory / (f"{name}.jsonl" if number == 1 else f"{name}.{number}.jsonl")


def files_of(directory: Path, name: str) -> tuple[Path, ...]:
    """Return the files of a stream that a folder holds, in the order in which its process was started anew."""
    found = (path for path in directory.glob("*.jsonl") if path.name.partition(".")[0] == name)
    own = (path for path in found if path == path_of(directory, name, number_of(path)))
    return tuple(sorted(own, key=number_of))


def number_of(path: Path) -> int:
    """Return the number in the name of a stream's file."""
    _, dot, number = path.stem.rpartition(".")
    return int(number) if dot and number.isdecimal() else 1


def _number_rows(schema: StreamSchema) -> NumberRows | None:
    digits = [field.digits for field in schema.fields]
    return None if all(places is None for places in digits) else NumberRows(digits)


class StreamFile:
    """One open stream: what waits, what was written, and how its values become a line."""

    __slots__ = (
        "_control_left",
        "_descriptor",
        "_newest_taken",
        "_pending",
        "_pending_cost",
        "_synced_bytes",
        "_whole_bytes",
        "bytes_written",
        "direct",
        "freed_bytes",
        "has_header",
        "has_t0",
        "lines",
        "not_finite",
        "overflowed",
        "path",
        "rows",
        "schema",
        "tap",
        "unwritten",
        "width",
        "written",
    )

    def __init__(self, schema: StreamSchema, path: Path, descriptor: int) -> None:
        self.schema = schema
        self.path = path
        self.width = len(schema.fields)
        self.direct: tuple[type, ...] = (tuple, list) if schema.shape == "array" else ()
        """Types of values that need no rearranging before they are encoded."""
        self.rows = _number_rows(schema)
        """Rounds its records; None where every digit is kept."""
        self.tap: Callable[[Any], None] | None = None
        """Given every record; None if nobody looks at them."""
        self.lines: list[bytes] = []
        self.overflowed = 0
        self.not_finite = 0
        self.written = 0
        self.unwritten = 0
        self.bytes_written = 0
        self.freed_bytes = 0
        """Buffered bytes that have left the buffer, ever."""
        self.has_header = False
        """Whether line 1 is written, or about to be."""
        self.has_t0 = False
        """Whether the file states simulated time zero, or is about to."""
        self._descriptor = descriptor
        self._newest_taken = b""
        self._pending: bytes = b""
        self._pending_cost = 0
        self._control_left = 0
        self._whole_bytes = 0
        self._synced_bytes = 0

    @property
    def dropped(self) -> int:
        """Records that will never be in the file."""
        return self.overflowed + self.unwritten

    @property
    def newest(self) -> bytes:
        """The record that was added last; empty before the first."""
        # In this order: the writer keeps what it is about to cut off.
        return b"".join(self.lines[-1:]) or self._newest_taken

    # What follows is called by the loop's thread.

    def tap_with(self, take: Callable[[Any], None]) -> None:
        """Give every record from now on to *take*, as it will be read: no value is spared being arranged."""
        self.tap, self.direct = take, ()

    def arrange(self, values: Any) -> Any:
        """
        Return *values* in the stream's shape, seen by who looks at records.

        Raises:
            PluginError: The number of values, or a name among them, is not the schema's.
        """
        arranged = self._arrange(values)
        if self.tap is not None:
            self.tap(arranged if self.rows is None else self.rows.rounded(arranged))
        return arranged

    def _arrange(self, values: Any) -> Any:
        if isinstance(values, Mapping):
            return self._arrange_mapping(values)
        if isinstance(values, np.ndarray):
            values = values.tolist() if values.ndim else (values.item(),)
        elif isinstance(values, str | bytes) or not isinstance(values, Sequence):
            raise PluginError(
                f"stream {self.schema.name}: expected one value per field, got {type(values).__name__}"
            )
        if len(values) != self.width:
            raise self.width_error(len(values))
        if self.schema.shape == "array":
            return list(values)
        return {f.name: value for f, value in zip(self.schema.fields, values, strict=True)}

    def _arrange_mapping(self, values: Mapping[str, Any]) -> Any:
        names = [field.name for field in self.schema.fields]
        missing = [name for name in names if name not in values]
        # An event carries details of its own beside the fields; an array has no room for them.
        is_array = self.schema.shape == "array"
        unknown = sorted(set(values) - set(names)) if is_array else []
        if missing or unknown:
            raise PluginError(
                f"stream {self.schema.name}: "
                + "; ".join(
                    f"{what} {', '.join(which)}"
                    for what, which in (("missing", missing), ("unknown", unknown))
                    if which
                )
            )
        return [values[name] for name in names] if is_array else dict(values)

    def width_error(self, got: int) -> PluginError:
        """Return the error for a record of *got* values."""
        names = ", ".join(field.name for field in self.schema.fields)
        return PluginError(
            f"stream {self.schema.name}: expected {self.width} values ({names}), got {got}"
        )

    # What follows is called by the writer thread, or once it has ended.

    def write_waiting(self, head: bytes, *, has_t0: bool) -> None:
        """
        Write all that waits at this moment.

        Args:
            head: A line that comes first and is no record; empty for none.
            has_t0: Whether simulated time zero is stated by that line or one before it.

        Raises:
            OSError: The file takes no more for now; the rest waits, and the next call goes on
                where this one stopped, be it within a line.
        """
        self._write_pending()
        left = len(self.lines)
        while head or left > 0:
            count = min(left, LINES_PER_WRITE_MAX)
            self._take(head, count)
            self.has_header = True
            self.has_t0 = has_t0
            head = b""
            left -= count
            self._write_pending()

    def _take(self, head: bytes, count: int) -> None:
        text = b"".join(self.lines[:count])
        if count:
            self._newest_taken = self.lines[count - 1]
        del self.lines[:count]
        self._pending = head + text
        self._pending_cost = len(text) + LINE_OVERHEAD_BYTES * count
        self._control_left = 1 if head else 0

    def _write_pending(self) -> None:
        while self._pending:
            count = os.write(self._descriptor, self._pending)
            self._account(self._pending[:count])
            self._pending = self._pending[count:]
        self.freed_bytes += self._pending_cost
        self._pending_cost = 0

    def _account(self, taken: bytes) -> None:
        whole = taken.rfind(b"\n") + 1
        if whole:
            self._whole_bytes = self.bytes_written + whole
        lines = taken.count(b"\n")
        control = min(lines, self._control_left)
        self._control_left -= control
        self.written += lines - control
        self.bytes_written += len(taken)

    def sync(self) -> None:
        """
        Make what was written durable, if there is anything new; a first time also the file's name.

        Raises:
            OSError: The disk refuses.
        """
        if self.bytes_written == self._synced_bytes:
            return
        if not self._synced_bytes:
            folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        written = self.bytes_written
        os.fdatasync(self._descriptor)
        self._synced_bytes = written

    def finish(self) -> list[OSError]:
        """Give up what the disk did not take, end the file on a whole line, say the counts in it, close it."""
        errors: list[OSError] = []
        records_left = self._pending.count(b"\n") - self._control_left
        self.unwritten += len(self.lines) + max(0, records_left)
        self.lines.clear()
        self._pending = b""
        fd = self._descriptor
        counts = {
            "records": self.written,
            "dropped": self.dropped,
            "not_finite": self.not_finite,
        }
        end = orjson.dumps({"end": counts}, option=orjson.OPT_APPEND_NEWLINE)
        for step in (self._cut_to_whole_line, lambda: self._write_end(end), lambda: os.fsync(fd)):
            try:
                step()
            except OSError as error:
                errors.append(error)
        os.close(fd)
        return errors

    def _cut_to_whole_line(self) -> None:
        if self.bytes_written > self._whole_bytes:
            os.ftruncate(self._descriptor, self._whole_bytes)
            self.bytes_written = self._whole_bytes

    def _write_end(self, end: bytes) -> None:
        """Write the end line whole or not at all; not into a file that has no line 1."""
        if not self.bytes_written:
            return
        try:
            while end:
                count = os.write(self._descriptor, end)
                self.bytes_written += count
                end = end[count:]
            self._whole_bytes = self.bytes_written
        except OSError:
            self._cut_to_whole_line()
            raise
