"""
Encodes records and puts them into a bounded buffer, from where a writer brings them to the disk.

`record` never waits for a writer thread. What does not fit the buffer is counted, stream by stream. One
thread, the loop's, may call a recorder, and a recorder does not survive a fork: make one in the child.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import orjson

from madns_runtime.config import Recording
from madns_runtime.errors import PluginError
from madns_runtime.recording.encoding import ENCODING, count_not_finite, explain_refusal, to_plain
from madns_runtime.recording.number_rows import NumberRows
from madns_runtime.recording.record_files import RecordCounts, RecordFiles
from madns_runtime.recording.records import StreamSchema
from madns_runtime.recording.stream_file import LINE_OVERHEAD_BYTES, StreamFile
from madns_runtime.recording.text_file import TextFile
from madns_runtime.recording.writer_thread import RecordWriter, WriterThread

WAKE_BYTES = 65_536
"""The writer is woken early when this much waits, or half of what may."""
CLOSE_TIMEOUT_S = 10.0


class StreamTap(Protocol):
    """An observer of some of the streams as they are recorded."""

    def open(
        self,
        stream: str,
        fields: Sequence[str],
        earlier: Callable[[], Iterable[Mapping[str, Any]]],
        seconds: str = "",
    ) -> Callable[[Sequence[Any] | Mapping[str, Any]], None] | None:
        """Return what is to be given every record of a stream with these fields, of which *seconds* is the first float in s; None if it is not looked at."""


class Recorder:
    """
    The record streams of one process (or of one agent of several in a process).

    Args:
        files: Where records go.
        settings: Bounds and intervals.
        writer: What brings them there; None for a thread of its own.
        rows_together: Records of numbers alone that are encoded at once, where whoever records can wait.
        tap: Looks at records; None if nobody does.
    """

    def __init__(
        self,
        files: RecordFiles,
        settings: Recording,
        writer: RecordWriter | None = None,
        *,
        rows_together: int = 1,
        tap: StreamTap | None = None,
    ) -> None:
        self._files = files
        self._writer = writer or WriterThread(settings).writes(files)
        self._limit_bytes = settings.buffer_bytes
        self._wake_bytes = min(WAKE_BYTES, settings.buffer_bytes // 2)
        self._queued_bytes = 0
        self._streams: dict[str, StreamFile] = {}
        self._texts: dict[str, TextFile] = {}
        self._rows_together = rows_together
        self._tap = tap
        self.start = self._writer.start

    def open_stream(self, schema: StreamSchema) -> None:
        """
        Open a stream and create its file, see `RecordFiles.create_stream`.

        Raises:
            PluginError: The schema is unfit, or a stream of that name is open.
            MachineError: The directory takes no new file.
        """
        if schema.name in self._streams:
            raise PluginError(f"stream {schema.name}: declared twice")
        file = self._streams[schema.name] = self._files.create_stream(schema)
        if self._tap is not None:
            names = [field.name for field in schema.fields]
            earlier = partial(self._files.earlier_records, file)
            take = self._tap.open(schema.name, names, earlier, schema.seconds)
            if take is not None:
                file.tap_with(take)

    def set_t0(self, t0_utc: str) -> None:
        """
        State when simulated time zero is, in UTC (ISO 8601).

        Streams whose first line is written from now on carry it there; to the others, whose first line
        is on the disk already, a line {"t0_utc": ...} is added.
        """
        self._files.t0_utc = t0_utc

    def record(self, stream: str, values: Sequence[Any] | Mapping[str, Any]) -> None:
        """
        Record one value per field; a mapping holds them by name. Never blocks, but where its writer does.

        Object streams take more names than the schema has. NaN and infinity become null and are counted.

        Raises:
            PluginError: The stream is unknown, the number of values is not the schema's, or a value
                has no JSON form.
            MachineError: The writer writes at once, and the disk refuses.
        """
        file = self._streams.get(stream)
        if file is None:
            raise PluginError(
                f"unknown stream {stream!r}; declared are: {', '.join(self._streams) or 'none'}"
            )
        if type(values) not in file.direct:
            values = file.arrange(values)
        elif len(values) != file.width:
            raise file.width_error(len(values))
        if (rows := file.rows) is not None:
            if self._rows_together > 1 and rows.is_fit(values):
                rows.waiting.append(values)
                if len(rows.waiting) >= self._rows_together:
                    self._encode_rows(file)
                return
            if rows.waiting:  # which come first
                self._encode_rows(file)
            values = rows.rounded([*values])
        self._encode(file, values)

    def _encode(self, file: StreamFile, values: Any) -> None:
        try:
            line = orjson.dumps(values, to_plain, ENCODING)
        except TypeError as error:
            raise explain_refusal(file.schema.name, values, error) from error
        if b"null" in line:
            file.not_finite += count_not_finite(values)
        self._queue(file, line)

    def _encode_rows(self, file: StreamFile) -> None:
        """Encode the records of numbers that wait for others."""
        rows = file.rows
        if rows is None or not rows.waiting:
            return
        try:
            lines, not_finite = rows.encode()
        except TypeError:  # a whole number of more than 64 bits
            self._encode_each(file, rows)
            return
        file.not_finite += not_finite
        for line in lines:
            self._queue(file, line)

    def _encode_each(self, file: StreamFile, rows: NumberRows) -> None:
        """
        Encode the records that wait one by one; what cannot be is dropped and counted.

        Raises:
            PluginError: One cannot be.
        """
        waiting, rows.waiting = rows.waiting, []
        fault: PluginError | None = None
        for values in waiting:
            try:
                self._encode(file, rows.rounded(values))
            except PluginError as error:
                file.overflowed += 1
                fault = fault or error
        if fault is not None:
            raise fault

    def _encode_late(self, file: StreamFile) -> None:
        """Encode what waits where nobody records just now: what cannot be is an error among those of the disk."""
        try:
            self._encode_rows(file)
        except PluginError as error:
            self._files.add_error(str(error))

    def _queue(self, file: StreamFile, line: bytes) -> None:
        line_bytes = len(line) + LINE_OVERHEAD_BYTES
        queued_bytes = self._queued_bytes + line_bytes
        waiting_bytes = queued_bytes - self._files.freed_bytes
        if waiting_bytes > self._limit_bytes:
            if line_bytes <= self._limit_bytes:
                self._writer.flush()  # one that writes at once makes room for it
            if queued_bytes - self._files.freed_bytes > self._limit_bytes:
                file.overflowed += 1
                return
        self._queued_bytes = queued_bytes
        file.lines.append(line)
        if waiting_bytes > self._wake_bytes:
            self._writer.flush()

    def flush(self) -> None:
        """
        Have what waits written without delay.

        Raises:
            MachineError: The writer writes at once, and the disk refuses.
        """
        for file in self._streams.values():
            self._encode_rows(file)
        self._writer.flush()

    def keep_text(self, name: str, data: bytes) -> None:
        """
        Keep what a program wrote in <name>.txt beside the records: its first part and its last. Never blocks.

        Raises:
            PluginError: The name is no file name, or the data are no bytes.
        """
        if not isinstance(data, bytes | bytearray | memoryview):
            raise PluginError(
                f"keep_text({name!r:.80}): expected bytes, got {type(data).__name__}; encode() a text"
            )
        text = self._texts.get(name)
        if text is None:
            text = self._texts[name] = self._files.create_text(name)
        text.add(bytes(data))

    def newest(self, stream: str) -> Mapping[str, Any]:
        """Return the newest record of a stream by its fields' names; empty where there is none."""
        file = self._streams.get(stream)
        if file is None:
            return {}
        self._encode_late(file)
        if not (line := file.newest):
            return {}
        record = orjson.loads(line)
        if isinstance(record, dict):
            return record
        return {field.name: value for field, value in zip(file.schema.fields, record, strict=True)}

    def counts(self) -> RecordCounts:
        """Return what was written and dropped until now."""
        return self._files.counts()

    @property
    def problem(self) -> str | None:
        """The first and the latest error of the disk; None if there was none."""
        return "; ".join(self._files.errors) or None

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> RecordCounts:
        """
        Write what waits and the end lines, make it durable, and return the last counts.

        What a full disk still refuses is dropped and counted. What is recorded from now on is dropped.

        Args:
            timeout_s: How long to wait for the disk; after it an error is in the counts.
        """
        for file in self._streams.values():
            self._encode_late(file)
        self._limit_bytes = -1
        self._writer.close(timeout_s)
        return self.counts()
