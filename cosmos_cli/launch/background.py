"""
Work that may wait for a machine, done in threads; the operator's loop hears of its end.

The loop itself never waits for a machine. Every task must have a deadline of its own.
"""

from __future__ import annotations

import contextlib
import os
import queue
import selectors
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

from cosmos_cli.fleet.failure import FailureKind, MachineFailure

T = TypeVar("T")

THREADS_MAX = 16
"""Machines that are waited for at a time; more tasks queue up."""
CLOSE_CHECK_S = 0.05

Report = Callable[[], None]


class BackgroundTasks:
    """
    Threads whose results come back through a pipe.

    Args:
        selector: The loop's.
    """

    def __init__(self, selector: selectors.BaseSelector) -> None:
        self.selector = selector
        self._tasks: queue.SimpleQueue[Callable[[], Report] | None] = queue.SimpleQueue()
        self._reports: deque[Report] = deque()
        self._read_fd, self._write_fd = os.pipe()
        os.set_blocking(self._read_fd, False)
        os.set_blocking(self._write_fd, False)
        self._threads = 0
        self._is_closed = False
        self._waking = threading.Lock()
        """Held from a report to the word of it: the pipe's number may be another file's once it is closed."""
        self.pending = 0
        """Tasks whose end has not been told yet."""
        selector.register(self._read_fd, selectors.EVENT_READ, self._news)

    def submit(
        self,
        task: Callable[[], T],
        on_done: Callable[[T | None, MachineFailure | None], None] = lambda value, failure: None,
    ) -> None:
        """
        Do *task* in a thread; *on_done* is called in the loop with its value or its failure.

        Raises:
            RuntimeError: It is closed.
        """
        if self._is_closed:
            raise RuntimeError("no more tasks are taken")
        self.pending += 1
        if self._threads < min(self.pending, THREADS_MAX):
            self._threads += 1
            # A thread lives until `close`: the kernel's death signal follows the thread that forked.
            threading.Thread(target=self._work, name="machines", daemon=True).start()
        self._tasks.put(lambda: _attempt(task, on_done))

    def close(self, timeout_s: float) -> bool:
        """Wait for what is under way; False if some of it has not ended in time."""
        until_s = time.monotonic() + timeout_s
        while self.pending and time.monotonic() < until_s:
            self._tell()
            time.sleep(CLOSE_CHECK_S)
        self._tell()
        self._is_closed = True
        self.selector.unregister(self._read_fd)
        if self.pending:  # a thread that is still at work needs its pipe
            return False
        for _ in range(self._threads):
            self._tasks.put(None)
        with self._waking:
            os.close(self._read_fd)
            os.close(self._write_fd)
        return True

    def _work(self) -> None:
        while (task := self._tasks.get()) is not None:
            report = task()
            with self._waking:
                self._reports.append(report)
                with contextlib.suppress(OSError):  # full: the loop will be woken anyway
                    os.write(self._write_fd, b"!")

    def _news(self, mask: int) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._read_fd, 4096)
        self._tell()

    def _tell(self) -> None:
        while self._reports:
            self.pending -= 1
            self._reports.popleft()()


def _attempt(
    task: Callable[[], Any], on_done: Callable[[Any, MachineFailure | None], None]
) -> Report:
    try:
        value = task()
    except MachineFailure as failure:
        caught = failure
        return lambda: on_done(None, caught)
    except Exception as error:  # noqa: BLE001 - a machine's surprise must not end the loop of all others
        surprise = MachineFailure(
            FailureKind.DEFECT,
            f"unexpected {type(error).__name__}: {error}",
            "please report this defect",
        )
        return lambda: on_done(None, surprise)
    return lambda: on_done(value, None)
