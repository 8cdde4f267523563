"""
All files of one recorder: its streams' and its texts', what was written of them, and what the disk said.

The loop's thread adds files; whoever writes (a thread of its own, or in lockstep the loop itself) calls the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import orjson

from madns_runtime.errors import MachineError
from madns_runtime.recording.encoding import ENCODING
from madns_runtime.recording.records import StreamSchema
from madns_runtime.recording.stream_file import StreamFile, create_file, number_of, path_of
from madns_runtime.recording.stream_rules import check_name, check_schema
from madns_runtime.recording.text_file import TextFile


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamCounts:
    """Counts of one stream's records."""

    file: str
    written: int
    dropped: int
    not_finite: int
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordCounts:
    """Counts of all records of a recorder, and its troubles on the way."""

    streams: Mapping[str, StreamCounts]
    errors: tuple[str, ...] = ()

    @property
    def written(self) -> int:
        """Records that a write call has taken."""
        return sum(counts.written for counts in self.streams.values())

    @property
    def dropped(self) -> int:
        """Records that will never be in a file."""
        return sum(counts.dropped for counts in self.streams.values())

    @property
    def not_finite(self) -> int:
        """NaN and infinite values, which became null."""
        return sum(counts.not_finite for counts in self.streams.values())

    @property
    def bytes(self) -> int:
        """Bytes in all files."""
        return sum(counts.bytes for counts in self.streams.values())

    def to_mapping(self) -> dict[str, Any]:
        """Return totals, errors and every stream's counts as plain mappings."""
        return {
            "written": self.written,
            "dropped": self.dropped,
            "not_finite": self.not_finite,
            "bytes": self.bytes,
            "errors": list(self.errors),
            "streams": {name: asdict(counts) for name, counts in self.streams.items()},
        }


class RecordFiles:
    """
    The files that one process, or one agent of several in a process, records into.

    Args:
        directory: Where the files go; made if it is missing.
        run: Name of the run.
        source: Who records: host, an agent's or a machine's name.
        incarnation: Which incarnation of its process this is; files are numbered from it.

    Raises:
        MachineError: The directory cannot be made.
    """

    def __init__(self, directory: Path, *, run: str, source: str, incarnation: int = 1) -> None:
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MachineError(f"{directory}: cannot record there: {error.strerror}") from error
        self.directory = directory
        self.t0_utc: str | None = None
        """Simulated time zero, in UTC (ISO 8601); None before it is known."""
        self.freed_bytes = 0
        """Buffered bytes that have left the buffer, ever."""
        self._run = run
        self._source = source
        self._incarnation = incarnation
        # New tuples at every change, so that the writer never walks one that changes.
        self._streams: tuple[StreamFile, ...] = ()
        self._texts: tuple[TextFile, ...] = ()
        self._first_error = self._latest_error = ""
        self._errors = 0

    def create_stream(self, schema: StreamSchema) -> StreamFile:
        """
        Create the file of a stream: <name>.jsonl, or <name>.<incarnation>.jsonl of a later incarnation.

        An existing file is left alone: the next free of .2, .3, ... is taken. The number that the
        first stream got is where all others begin: it tells which incarnation of the process they are of, also
        when an earlier one ended before it had opened them all.

        Raises:
            PluginError: The schema is unfit.
            MachineError: The directory takes no new file.
        """
        check_schema(schema)
        path, descriptor, number = create_file(self.directory, schema.name, self._incarnation)
        if not self._streams:
            self._incarnation = number
        file = StreamFile(schema, path, descriptor)
        self._streams = (*self._streams, file)
        return file

    def earlier_records(self, file: StreamFile) -> Iterator[dict[str, Any]]:
        """Give what earlier incarnations have recorded of a stream, by field; what cannot be read is left out."""
        from madns_runtime.recording.reader import read_stream  # few incarnations are not the first

        number = number_of(file.path)
        for earlier in range(1, number):
            try:
                stream = read_stream(path_of(self.directory, file.schema.name, earlier))
                names = stream.field_names
                for row in stream.records():
                    yield row if isinstance(row, dict) else dict(zip(names, row, strict=True))
            except MachineError:
                continue

    def create_text(self, name: str) -> TextFile:
        """
        Return the text file <name>.txt, which is created when there is something to write.

        Raises:
            PluginError: The name is no file name.
        """
        check_name(name)
        text = TextFile(self.directory / f"{name}.txt")
        self._texts = (*self._texts, text)
        return text

    def counts(self) -> RecordCounts:
        """Return what was written and dropped until now."""
        streams = {
            file.schema.name: StreamCounts(
                file=file.path.name,
                written=file.written,
                dropped=file.dropped,
                not_finite=file.not_finite,
                bytes=file.bytes_written,
            )
            for file in self._streams
        }
        return RecordCounts(streams=streams, errors=self.errors)

    @property
    def errors(self) -> tuple[str, ...]:
        """The first error of the disk and the latest, with their number; empty if there was none."""
        if self._errors < 2:
            return (self._first_error,) if self._errors else ()
        return (self._first_error, f"latest of {self._errors}: {self._latest_error}")

    def add_error(self, text: str) -> None:
        """Keep an error, if it is the first, and as the latest."""
        self._errors += 1
        self._first_error = self._first_error or text
        self._latest_error = text

    # What follows is called by whoever writes.

    def write_waiting(self) -> bool:
        """Write all that waits; False if the disk refused some of it, which waits on."""
        t0_utc, streams = self.t0_utc, self._streams
        done = [
            self._try(
                file.path,
                partial(file.write_waiting, self._head(file, t0_utc), has_t0=t0_utc is not None),
            )
            for file in streams
        ]
        done += [self._try(text.path, text.write_waiting) for text in self._texts]
        self.freed_bytes = sum(file.freed_bytes for file in streams)
        return all(done)

    def sync(self) -> bool:
        """Bring what is written to the disk itself, where a power cut leaves it; False if it refused."""
        return all([self._try(file.path, file.sync) for file in self._streams])

    def finish(self) -> None:
        """Give up what the disk does not take, write the end lines, and close."""
        for file in self._streams:
            for error in file.finish():
                self.add_error(_describe(file.path, error))
        for text in self._texts:
            self._try(text.path, text.finish)

    def _try(self, path: Path, write: Callable[[], None]) -> bool:
        try:
            write()
        except OSError as error:
            self.add_error(_describe(path, error))
            return False
        return True

    def _head(self, file: StreamFile, t0_utc: str | None) -> bytes:
        """Return what the file still lacks at its head: line 1, or the line that states T0, or nothing."""
        if not file.has_header:
            header = file.schema.header(run=self._run, source=self._source, t0_utc=t0_utc)
            return orjson.dumps(header, None, ENCODING)
        if t0_utc is not None and not file.has_t0:
            return orjson.dumps({"t0_utc": t0_utc}, None, ENCODING)
        return b""


def _describe(path: Path, error: OSError) -> str:
    utc = datetime.now(UTC).isoformat(timespec="seconds")
    return f"{path}: {error.strerror or error} ({utc})"
