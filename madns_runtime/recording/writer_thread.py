"""Records on their way from a loop that never waits to the disk: one thread does the write calls."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from time import monotonic
from typing import Protocol

from madns_runtime.config import Recording
from madns_runtime.recording.record_files import RecordFiles


class RecordWriter(Protocol):
    """Writer of the bytes that wait in a recorder's files."""

    def start(self) -> None:
        """Begin to write; what was recorded before is written first."""

    def flush(self) -> None:
        """
        Have what waits written without delay.

        Raises:
            MachineError: It is written here and now, and the disk refuses.
        """

    def close(self, timeout_s: float) -> None:
        """Write what waits and the end lines, for so long at most; once is enough."""


class WriterThread:
    """
    A thread that writes what waits, now and then or when much does.

    Args:
        files: What it writes.
        settings: How often it writes and brings to the disk itself.
    """

    def __init__(self, files: RecordFiles, settings: Recording) -> None:
        self._files = files
        self._settings = settings
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._write_on, name="recorder", daemon=True)

    def start(self) -> None:
        """Start the thread, if it is not started."""
        if self._thread.ident is None:
            self._thread.start()

    def flush(self) -> None:
        """Wake the thread."""
        if not self._wake.is_set():
            self._wake.set()

    def close(self, timeout_s: float) -> None:
        """End the thread when it has written all; a disk that takes longer is an error in the counts."""
        self.start()
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            directory = self._files.directory
            self._files.add_error(f"{directory}: records not on disk after {timeout_s:g} s")

    def _write_on(self) -> None:
        _schedule_normally()
        files, is_troubled = self._files, False
        interval_s = self._settings.sync_interval_s or math.inf
        synced_s = monotonic()
        while not self._stop.is_set():
            # In trouble only the interval counts: a full buffer would wake without pause.
            (self._stop if is_troubled else self._wake).wait(self._settings.flush_interval_s)
            self._wake.clear()
            is_troubled = not files.write_waiting()
            if monotonic() - synced_s >= interval_s:
                is_troubled |= not files.sync()
                synced_s = monotonic()
        files.write_waiting()
        files.finish()


def _schedule_normally() -> None:
    """Leave SCHED_FIFO, which a thread inherits: the disk's work must not compete with a loop."""
    # Where it stays as it is, the loop records what scheduling it was granted.
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
