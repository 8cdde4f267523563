"""Times that the kernel counts: stolen by the hypervisor, waited for a processor, and computed by another thread."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Final

STAT: Final = Path("/proc/stat")
SCHEDSTAT: Final = Path("/proc/thread-self/schedstat")
TASKS: Final = Path("/proc/self/task")
STEAL_AT: Final = 8
"""Place of the stolen time in the line of all processors (proc(5))."""
TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
READ_BYTES: Final = 4096
READINGS_MAX: Final = 64


def thread_computed_s(thread_id: int) -> float:
    """Return the CPU time of a thread of this process since its start, s; 0 where not told, or it has ended."""
    fields = _read(TASKS / str(thread_id) / SCHEDSTAT.name).split()
    return int(fields[0]) * 1e-9 if fields else 0.0


class KernelFile:
    """
    A count of the kernel's whose file is kept open: reading it again is one system call, of a microsecond.

    Args:
        path: The file.
        parse: Finds the count in it, s; in nothing as well, where there is no such file or it is closed.
    """

    def __init__(self, path: Path, parse: Callable[[bytes], float]) -> None:
        self._parse = parse
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            self._descriptor = -1

    @classmethod
    def of_stolen_time(cls, path: Path = STAT) -> KernelFile:
        """Return that of the time since the machine's start that others took from all its processors; 0 where not told."""
        return cls(path, _stolen_in_s)

    @classmethod
    def of_waiting(cls, path: Path = SCHEDSTAT) -> KernelFile:
        """
        Return that of the time for which the calling thread was ready to run and did not, since its start.

        Whoever reads it then; infinite where not told.
        """
        return cls(path, _waited_in_s)

    def __call__(self) -> float:
        """Read it, s."""
        if self._descriptor < 0:
            return self._parse(b"")
        try:
            return self._parse(os.pread(self._descriptor, READ_BYTES, 0))
        except OSError:
            return self._parse(b"")

    def close(self) -> None:
        """Read nothing more."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1


class KernelCount:
    """
    The newest readings of something that the kernel counts.

    Args:
        count: Reads it, s.
        interval_s: It is not read more often.
        now_s: The clock.
    """

    def __init__(
        self,
        count: Callable[[], float],
        interval_s: float,
        now_s: Callable[[], float] = monotonic,
    ) -> None:
        self._count = count
        self._interval_s = interval_s
        self._now_s = now_s
        self._readings = deque([(now_s(), count())], maxlen=READINGS_MAX)

    @property
    def newest_s(self) -> float:
        """The newest reading, s."""
        return self._readings[-1][1]

    def read(self, now_s: float | None = None) -> None:
        """Read it, unless that was done just now; *now_s* is the clock's time, if it has been asked already."""
        if now_s is None:
            now_s = self._now_s()
        if now_s - self._readings[-1][0] >= self._interval_s:
            self._readings.append((now_s, self._count()))

    def grown_since(self, since_s: float) -> float:
        """
        Return by how much it had grown at the newest reading, s; infinite where the kernel does not tell.

        Counted from the newest reading that is no later than *since_s*, or else the oldest one.
        """
        newest = self.newest_s
        before = next((count for at_s, count in reversed(self._readings) if at_s <= since_s), None)
        if before is None:
            before = self._readings[0][1]
        return newest - before if math.isfinite(newest) else math.inf


def _stolen_in_s(text: bytes) -> float:
    fields = text.split(b"\n", 1)[0].split()
    return int(fields[STEAL_AT]) / TICKS_PER_S if len(fields) > STEAL_AT else 0.0


def _waited_in_s(text: bytes) -> float:
    fields = text.split()
    return int(fields[1]) * 1e-9 if len(fields) > 1 else math.inf


def _read(path: Path) -> bytes:
    try:
        with open(path, "rb", buffering=0) as file:
            return file.read(READ_BYTES)
    except OSError:
        return b""
