"""
A clock for deadlines of processes that may be starved: it stands while they wait for a processor.

What a process computes, and what it sleeps of its own accord, counts; what the kernel keeps it waiting for
a processor does not. So a busy computer ends no wait, and a call that loops or sleeps for ever still
does. A process that is stopped (SIGSTOP, a debugger) waits for no processor: its time counts. Where the
kernel does not tell, all time counts. The readings are taken here; what they mean is pure.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Final, TypeVar

UNMEASURED_S: Final = 0.5
"""First part of a `GrantedLimit`, in which nobody looks; it does not count."""
LOOK_S_MAX: Final = 1.5
"""Of the time between two looks at most this much counts: whoever did not look may have been starved itself."""
LOOK_INTERVAL_S: Final = 0.02
"""Least time between two looks."""
COST_SHARE_MAX: Final = 0.02
"""Largest share of its caller's time that looking may take."""
PROCESSES_MAX: Final = 10_000
"""Processes of one tree that are looked at."""
PROC: Final = Path("/proc")
TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100

T = TypeVar("T")
ThreadName = tuple[int, int]
"""Process and thread."""


@dataclass(frozen=True, slots=True)
class ThreadReading:
    """The kernel's figures of one thread."""

    is_runnable: bool
    """It computes, or would if it had a processor."""
    cpu_s: float
    """Time on a processor since its start, s."""
    delay_s: float
    """Time that it was runnable and had none, s; a wait under way is not in it yet."""


Readings = Mapping[ThreadName, ThreadReading]


def waited_s(before: Readings, now: Readings, elapsed_s: float) -> float:
    """
    Return for how long some thread has waited for a processor between two readings, s.

    Args:
        before: The earlier readings.
        now: The later ones.
        elapsed_s: The time between them.
    """
    waits = (_wait_of(before.get(name), reading, elapsed_s) for name, reading in now.items())
    return min(max(waits, default=0.0), elapsed_s)


def _wait_of(before: ThreadReading | None, now: ThreadReading, elapsed_s: float) -> float:
    delay_s = now.delay_s - (before.delay_s if before else 0.0)
    if not now.is_runnable:
        return delay_s
    # The wait under way is counted by the kernel only when it is over.
    return max(delay_s, elapsed_s - (now.cpu_s - (before.cpu_s if before else 0.0)))


def read_trees(roots: Iterable[int]) -> Readings:
    """Return the readings of all threads of processes and of all that descend from them, but the caller's own thread."""
    own = (os.getpid(), threading.get_native_id())
    waiting, seen = list(roots), set[int]()
    readings: dict[ThreadName, ThreadReading] = {}
    while waiting and len(seen) < PROCESSES_MAX:
        pid = waiting.pop()
        if pid in seen:
            continue
        seen.add(pid)
        for tid in _threads(pid):
            folder = f"{PROC}/{pid}/task/{tid}"
            waiting += map(int, _read(f"{folder}/children").split())
            reading = _read_thread(folder)
            if reading is not None and (pid, tid) != own:
                readings[pid, tid] = reading
    return readings


class GrantedClock:
    """
    The time that processes were not kept waiting for a processor, s; 0 when it is made.

    Args:
        roots: Returns the processes that are waited for; what descends from them counts as well.
        read: Takes the readings.
        clock: The computer's monotonic clock.
    """

    def __init__(
        self,
        roots: Callable[[], Iterable[int]],
        *,
        read: Callable[[Iterable[int]], Readings] = read_trees,
        clock: Callable[[], float] = monotonic,
    ) -> None:
        self._roots = roots
        self._read = read
        self._clock = clock
        self._granted_s = 0.0
        self._looked_s = clock()
        self._readings = read(roots())
        self._interval_s = self._pause_after(clock() - self._looked_s)

    def now_s(self) -> float:
        """Look, unless that was just done, and return the time, s."""
        now_s = self._clock()
        elapsed_s = now_s - self._looked_s
        if elapsed_s >= self._interval_s:
            readings = self._read(self._roots())
            counted_s = elapsed_s - waited_s(self._readings, readings, elapsed_s)
            self._granted_s += min(counted_s, LOOK_S_MAX)
            self._looked_s, self._readings = now_s, readings
            self._interval_s = self._pause_after(self._clock() - now_s)
        return self._granted_s

    def _pause_after(self, cost_s: float) -> float:
        return max(LOOK_INTERVAL_S, min(cost_s / COST_SHARE_MAX, LOOK_S_MAX / 2))


class GrantedLimit:
    """
    The end of one wait; one that is soon over is not measured, so that a run that goes well pays nothing.

    Args:
        limit_s: How long it may last, in time that the processes waited for had processors or did not want any.
        roots: Returns these processes; this one and its descendants if None.
    """

    def __init__(
        self, limit_s: float, roots: Callable[[], Iterable[int]] = lambda: (os.getpid(),)
    ) -> None:
        self.limit_s = limit_s
        self._roots = roots
        self._began_s = monotonic()
        self._clock: GrantedClock | None = None

    def is_over(self) -> bool:
        """Look whether the time is over; to be called at least once per second."""
        if self._clock is None:
            if monotonic() - self._began_s >= min(UNMEASURED_S, self.limit_s):
                self._clock = GrantedClock(self._roots)
            return False
        return self._clock.now_s() > self.limit_s


def repeat_until_granted(attempt: Callable[[], T], limit_s: float) -> T:
    """
    Call *attempt* anew as long as it raises TimeoutError, and return what it returns.

    Args:
        attempt: Waits a short while itself.
        limit_s: How long, in time granted to this process, but the calling thread, and to all that it has started.

    Raises:
        TimeoutError: The time is over.
    """
    granted = GrantedClock(lambda: (os.getpid(),))
    while True:
        try:
            return attempt()
        except TimeoutError:
            if granted.now_s() >= limit_s:
                raise


def is_stopped(pid: int) -> bool:
    """Tell whether a process is stopped, as by SIGSTOP or a debugger."""
    return _state(_read(f"{PROC}/{pid}/stat")) in ("T", "t")


def _threads(pid: int) -> list[int]:
    try:
        return [int(name) for name in os.listdir(f"{PROC}/{pid}/task")]
    except OSError:  # it has ended, or there is no such thing here
        return []


def _read_thread(folder: str) -> ThreadReading | None:
    stat = _read(f"{folder}/stat")
    state = _state(stat)
    if not state:
        return None
    times = _read(f"{folder}/schedstat").split()
    if len(times) >= 2:
        return ThreadReading(state == "R", int(times[0]) * 1e-9, int(times[1]) * 1e-9)
    # A kernel without these statistics: coarser, and only a wait under way is seen.
    fields = stat[stat.rfind(")") + 1 :].split()
    return ThreadReading(state == "R", (int(fields[11]) + int(fields[12])) / TICKS_PER_S, 0.0)


def _state(stat: str) -> str:
    """Return the letter of a thread's state; empty if it has ended."""
    # The name, in parentheses, may hold spaces and parentheses.
    fields = stat[stat.rfind(")") + 1 :].split()
    return fields[0] if len(fields) > 12 else ""


def _read(path: str) -> str:
    try:
        with open(path, "rb", buffering=0) as file:
            return file.read(65_536).decode("latin-1")
    except OSError:
        return ""
