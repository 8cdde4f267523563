"""Records on their way from a loop that never waits to the disk: one thread does the write calls."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from time import monotonic, thread_time
from typing import Protocol

from madns_runtime.config import Recording
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.timing.kernel_times import thread_computed_s
from madns_runtime.timing.late_causes import overlap_s

FIFO_PRIORITY = 1
"""Of SCHED_FIFO: the least there is."""


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
    A thread that writes what waits, now and then or when much does: of one recorder, or of all in a process.

    Args:
        settings: How often it writes and brings to the disk itself.
    """

    def __init__(self, settings: Recording) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._hurry = threading.Event()
        self._writings: list[_Writing] = []
        self._thread: threading.Thread | None = None
        self._newest_pass = (-math.inf, -math.inf, 0.0)
        """Begin and end of the last time that it wrote, s of the monotonic clock, and the CPU time that this took, s."""
        self._pass_under_way: tuple[float, float] | None = None
        """Its begin, and the thread's CPU time then, s."""
        self._thread_id = 0
        self._follows_fifo = False

    def writes(self, files: RecordFiles) -> RecordWriter:
        """Return the writer of some more files."""
        return _Writing(self, files, self._wake)

    def start(self, writing: _Writing) -> None:
        """Begin to write what *writing* has, if that has not begun."""
        with self._lock:
            if writing in self._writings or writing.is_done.is_set():
                return
            self._writings.append(writing)
            if self._thread is None:
                self._thread = threading.Thread(target=self._write_on, name="recorder", daemon=True)
                self._thread.start()

    def follow(self, priority: int) -> None:
        """
        Compute before all programs of the normal policy, if the loop that records does so as well.

        Whatever keeps this thread from computing while it has the interpreter keeps that loop waiting for it.

        Args:
            priority: SCHED_FIFO priority of that loop; 0 with the normal policy. One that is no higher than
                FIFO_PRIORITY is not followed: this thread would not give way to the loop.
        """
        self._follows_fifo = priority > FIFO_PRIORITY

    def computed_within_s(self, window: tuple[float, float]) -> float:
        """
        Return for how long at most it computed in a time that has just passed, s: in its newest pass.

        Args:
            window: Begin and end, s of the monotonic clock.
        """
        under_way = self._pass_under_way
        began_s, ended_s, computed_s = self._newest_pass
        if under_way is not None and under_way[0] < window[1]:
            began_s, ended_s = under_way[0], math.inf
            computed_s = max(0.0, thread_computed_s(self._thread_id) - under_way[1])
        return min(computed_s, overlap_s(began_s, ended_s, window))

    def hurry(self) -> None:
        """Write now, also where the disk has just refused: somebody closes."""
        self._hurry.set()
        self._wake.set()

    def _write_on(self) -> None:
        # SCHED_FIFO at its loop's priority, which a thread may inherit, would let it compete with that loop.
        _schedule("SCHED_OTHER", 0)
        self._thread_id = threading.get_native_id()
        is_troubled = is_raised = False
        interval_s = self._settings.sync_interval_s or math.inf
        synced_s = monotonic()
        while True:
            # In trouble only the interval counts: a full buffer would wake without pause.
            (self._hurry if is_troubled else self._wake).wait(self._settings.flush_interval_s)
            self._wake.clear()
            self._hurry.clear()
            if self._follows_fifo and not is_raised:
                is_raised = True
                _schedule("SCHED_FIFO", FIFO_PRIORITY)
            began_s, computed_s = self._pass_under_way = monotonic(), thread_time()
            closing = [writing for writing in self._writings if writing.is_closing]
            must_sync = monotonic() - synced_s >= interval_s
            writings = list(self._writings)
            is_troubled = not all([writing.is_written(must_sync) for writing in writings])
            if must_sync:
                synced_s = monotonic()
            self._newest_pass = (began_s, monotonic(), thread_time() - computed_s)
            self._pass_under_way = None
            for writing in closing:
                writing.finish()
            with self._lock:
                self._writings = [one for one in self._writings if one not in closing]
                if not self._writings:
                    self._thread = None
                    return


class _Writing:
    """One recorder's part of what a thread writes."""

    def __init__(self, thread: WriterThread, files: RecordFiles, wake: threading.Event) -> None:
        self.files = files
        self.is_closing = False
        self.is_done = threading.Event()
        self._thread = thread
        self._wake = wake

    def is_written(self, must_sync: bool) -> bool:
        """Write what waits, and bring it to the disk itself if it *must_sync*; return whether all went well."""
        try:
            is_written = self.files.write_waiting()
            return self.files.sync() and is_written if must_sync else is_written
        except Exception as error:  # noqa: BLE001 - others share the thread: told, and tried again
            self.files.add_error(f"{self.files.directory}: {type(error).__name__}: {error}")
            return False

    def finish(self) -> None:
        """Give up what is not written, close the files, and let go whoever waits for that."""
        try:
            self.files.finish()
        except Exception as error:  # noqa: BLE001 - others share the thread
            self.files.add_error(f"{self.files.directory}: {type(error).__name__}: {error}")
        finally:
            self.is_done.set()

    def start(self) -> None:
        """Start the thread, if it is not started."""
        self._thread.start(self)

    def flush(self) -> None:
        """Wake the thread."""
        if not self._wake.is_set():
            self._wake.set()

    def close(self, timeout_s: float) -> None:
        """Have all written and finished; a disk that takes longer is an error in the counts."""
        self.start()
        self.is_closing = True
        self._thread.hurry()
        if not self.is_done.wait(timeout_s):
            self.files.add_error(
                f"{self.files.directory}: records not on disk after {timeout_s:g} s"
            )


def _schedule(policy: str, priority: int) -> None:
    """Ask for a scheduling policy for the calling thread; what is refused stays as it was."""
    # Where it stays as it is, the loop records what scheduling it was granted.
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, getattr(os, policy), os.sched_param(priority))
