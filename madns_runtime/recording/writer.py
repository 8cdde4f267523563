"""
Records on their way from a loop to the disk.

`record` encodes and appends to a bounded buffer, and never waits; one writer thread does the write calls.
What does not fit the buffer is counted, stream by stream. One thread, the loop's, may call a recorder,
and a recorder does not survive a fork: make one in the child.
"""

from __future__ import annotations

import logging
import math
import os
import threading
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from typing import Any

import orjson

from madns_runtime.config import Recording
from madns_runtime.errors import MachineError, PluginError
from madns_runtime.recording.counts import RecordCounts, StreamCounts
from madns_runtime.recording.encoding import ENCODING, count_not_finite, explain_refusal, to_plain
from madns_runtime.recording.records import LOG, StreamSchema
from madns_runtime.recording.stream_file import (
    LINE_OVERHEAD_BYTES,
    StreamFile,
    check_schema,
    create_file,
)
from madns_runtime.timing.clock import utc_now_iso

WAKE_BYTES = 65_536
"""The writer is woken early when this much waits."""
CLOSE_TIMEOUT_S = 10.0
LEVELS = {
    "critical": logging.CRITICAL,
    "error": logging.ERROR,
    "warning": logging.WARNING,
    "info": logging.INFO,
    "debug": logging.DEBUG,
}
VERBOSITY_LEVELS = (logging.CRITICAL + 1, 50, 40, 30, 20, 10)
"""The least level that recording.verbosity 0 to 5 lets through, as logging numbers them."""


class Recorder:
    """
    The record streams of one process (or of one agent of several in a process).

    Args:
        directory: Where the files go; made if it is missing.
        run: Name of the run.
        source: Who records: host, an agent's or a machine's name.
        settings: Bounds, interval and verbosity.
        life: Which life of its process this is; files are numbered from it.

    Raises:
        MachineError: The directory cannot be made.
    """

    def __init__(
        self, directory: Path, *, run: str, source: str, settings: Recording, life: int = 1
    ) -> None:
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MachineError(f"{directory}: cannot record there: {error.strerror}") from error
        self._directory = directory
        self._run = run
        self._source = source
        self._settings = settings
        self._level = VERBOSITY_LEVELS[settings.verbosity]
        self._limit_bytes = settings.buffer_bytes
        self._files: dict[str, StreamFile] = {}
        self._life = life
        self._queued_bytes = 0
        self._freed_bytes = 0
        self._t0_utc: str | None = None
        self._troubles = _Troubles()
        self._is_closing = False
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open_stream(self, schema: StreamSchema) -> None:
        """
        Create the file of a stream: <name>.jsonl, or <name>.<life>.jsonl of a later life.

        An existing file is left alone: the next free of .2, .3, ... is taken. The number that the
        first stream got is where all others begin: it tells which life of the process they are of, also
        when an earlier one ended before it had opened them all.

        Raises:
            PluginError: The schema is unfit, or a stream of that name is open.
            MachineError: The directory takes no new file.
        """
        check_schema(schema)
        if schema.name in self._files:
            raise PluginError(f"stream {schema.name}: declared twice")
        path, descriptor, number = create_file(self._directory, schema.name, self._life)
        if not self._files:
            self._life = number
        # A new dictionary, so that the writer thread never walks one that changes.
        self._files = {**self._files, schema.name: StreamFile(schema, path, descriptor)}

    def set_t0(self, t0_utc: str) -> None:
        """
        State when simulated time zero is, in UTC (ISO 8601).

        Streams whose first line is written from now on carry it there; to the others, whose first line
        is on the disk already, a line {"t0_utc": ...} is added.
        """
        self._t0_utc = t0_utc

    def start(self) -> None:
        """Start the writer thread; what was recorded before is written first."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._write_on, name="recorder", daemon=True)
            self._thread.start()

    def record(self, stream: str, values: Sequence[Any] | Mapping[str, Any]) -> None:
        """
        Record one value a field; a mapping holds them by name. Never blocks.

        Object streams take more names than the schema has. NaN and infinity become null and are counted.

        Raises:
            PluginError: The stream is unknown, the number of values is not the schema's, or a value
                has no JSON form.
        """
        file = self._files.get(stream)
        if file is None:
            raise PluginError(
                f"unknown stream {stream!r}; declared are: {', '.join(self._files) or 'none'}"
            )
        if type(values) not in file.direct:
            values = file.arrange(values)
        elif len(values) != file.width:
            raise file.width_error(len(values))
        try:
            line = orjson.dumps(values, to_plain, ENCODING)
        except TypeError as error:
            raise explain_refusal(stream, values, error) from error
        if b"null" in line:
            file.not_finite += count_not_finite(values)
        queued_bytes = self._queued_bytes + len(line) + LINE_OVERHEAD_BYTES
        waiting_bytes = queued_bytes - self._freed_bytes
        if waiting_bytes > self._limit_bytes or self._is_closing:
            file.overflowed += 1
            return
        self._queued_bytes = queued_bytes
        file.lines.append(line)
        if waiting_bytes > WAKE_BYTES and not self._wake.is_set():
            self._hurry()

    def log(self, level: str, text: str, t_s: float | None = None) -> None:
        """
        Log a sentence, if it is loud enough for recording.verbosity.

        Args:
            level: critical, error, warning, info or debug.
            text: The sentence.
            t_s: Simulated time, s; None where it does not run.

        Raises:
            PluginError: The level is none of these.
        """
        number = LEVELS.get(level)
        if number is None:
            raise PluginError(f"unknown log level {level!r}; expected one of {', '.join(LEVELS)}")
        if number < self._level:
            return
        # A lone surrogate, as in a file name that is no UTF-8, has no place in JSON.
        text = text.encode("utf-8", "backslashreplace").decode("utf-8")
        if LOG.name in self._files:
            self.record(LOG.name, (t_s, self._utc(), level, text))

    def counts(self) -> RecordCounts:
        """Return what was written and dropped until now."""
        streams = {
            name: StreamCounts(
                file=file.path.name,
                written=file.written,
                dropped=file.dropped,
                not_finite=file.not_finite,
                bytes=file.bytes_written,
            )
            for name, file in self._files.items()
        }
        return RecordCounts(streams=streams, errors=self._troubles.texts())

    @property
    def problem(self) -> str | None:
        """The first and the latest error of the disk; None if there was none."""
        return "; ".join(self._troubles.texts()) or None

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> RecordCounts:
        """
        Write what waits and the end lines, make it durable, and return the last counts.

        What a full disk still refuses is dropped and counted. What is recorded from now on is dropped.

        Args:
            timeout_s: How long to wait for the disk; after it an error is in the counts.
        """
        self._is_closing = True
        self.start()
        self._stop.set()
        self._wake.set()
        thread = self._thread
        if thread is not None:
            thread.join(timeout_s)
            if thread.is_alive():
                self._troubles.add(f"{self._directory}: records not on disk after {timeout_s:g} s")
        return self.counts()

    def _hurry(self) -> None:
        """Much waits."""
        self._wake.set()

    def _utc(self) -> str:
        """Return the time that events and logged sentences carry."""
        return utc_now_iso()

    def _write_on(self) -> None:
        _schedule_normally()
        is_troubled = False
        interval_s = self._settings.sync_interval_s or math.inf
        synced_s = monotonic()
        while not self._stop.is_set():
            # In trouble only the interval counts: a full buffer would wake without pause.
            (self._stop if is_troubled else self._wake).wait(self._settings.flush_interval_s)
            self._wake.clear()
            is_troubled = not self._flush()
            if monotonic() - synced_s >= interval_s:
                is_troubled |= not self._sync()
                synced_s = monotonic()
        self._flush()
        self._finish_files()

    def _finish_files(self) -> None:
        for file in self._files.values():
            for error in file.finish():
                self._troubles.add(_describe(file, error))

    def _flush(self) -> bool:
        t0_utc = self._t0_utc
        is_well = True
        files = self._files.values()
        for file in files:
            try:
                file.write_waiting(self._head(file, t0_utc), has_t0=t0_utc is not None)
            except OSError as error:
                self._troubles.add(_describe(file, error))
                is_well = False
        self._freed_bytes = sum(file.freed_bytes for file in files)
        return is_well

    def _sync(self) -> bool:
        """Bring what is written to the disk itself, where a power cut leaves it."""
        is_well = True
        for file in self._files.values():
            try:
                file.sync()
            except OSError as error:
                self._troubles.add(_describe(file, error))
                is_well = False
        return is_well

    def _head(self, file: StreamFile, t0_utc: str | None) -> bytes:
        """Return what the file still lacks at its head: line 1, or the line that states T0, or nothing."""
        if not file.has_header:
            header = file.schema.header(run=self._run, source=self._source, t0_utc=t0_utc)
            return orjson.dumps(header, None, ENCODING)
        if t0_utc is not None and not file.has_t0:
            return orjson.dumps({"t0_utc": t0_utc}, None, ENCODING)
        return b""


class _Troubles:
    """The first error, the latest, and how many there were."""

    def __init__(self) -> None:
        self._first = ""
        self._latest = ""
        self._count = 0

    def add(self, text: str) -> None:
        self._count += 1
        self._first = self._first or text
        self._latest = text

    def texts(self) -> tuple[str, ...]:
        if not self._count:
            return ()
        if self._count == 1:
            return (self._first,)
        return (self._first, f"latest of {self._count}: {self._latest}")


def _describe(file: StreamFile, error: OSError) -> str:
    utc = datetime.now(UTC).isoformat(timespec="seconds")
    return f"{file.path}: {error.strerror or error} ({utc})"


def _schedule_normally() -> None:
    """Leave SCHED_FIFO, which a thread inherits: the disk's work must not compete with a loop."""
    if hasattr(os, "sched_setscheduler"):
        try:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        except OSError:
            return  # It stays as it is; the loop records what scheduling it was granted.
