"""The queue of timers of a loop, pure: it is told the time."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable

STALE_MAX = 64
"""Entries of cancelled timers that may stay in the queue before it is swept, if they are the most of it."""


class Timer:
    """
    A callback at a time; made by `Reactor.call_at`.

    It fires once; `reschedule`, from within its callback too, lets the same object fire again and
    costs less than a new one.
    """

    __slots__ = ("_queue", "_queued_s", "callback", "sequence", "when_s")

    def __init__(
        self, queue: TimerQueue, sequence: int, when_s: float, callback: Callable[[], None]
    ) -> None:
        self._queue = queue
        # The time of this timer's one live entry in the queue; None without one.
        self._queued_s: float | None = None
        self.sequence = sequence
        self.callback = callback
        self.when_s = when_s
        """Time at which it fires or fired, s of the reactor's clock."""

    def cancel(self) -> None:
        """Do not fire; without effect on a timer that is not pending."""
        self._queue.cancel(self)

    def reschedule(self, when_s: float) -> None:
        """Fire at *when_s* instead, or again."""
        self._queue.schedule(self, when_s)


class TimerQueue:
    """
    Timers by time, those of the same time in the order in which they were made.

    A timer moved to a later time keeps its entry and is put where it belongs when that comes up: a
    watchdog that every packet puts off costs two assignments.
    """

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Timer]] = []
        self._sequence = 0
        self._stale = 0

    def __len__(self) -> int:
        """Return the number of entries, stale ones included."""
        return len(self._heap)

    def add(self, when_s: float, callback: Callable[[], None]) -> Timer:
        """Make a timer."""
        self._sequence += 1
        timer = Timer(self, self._sequence, when_s, callback)
        self.schedule(timer, when_s)
        return timer

    def schedule(self, timer: Timer, when_s: float) -> None:
        """
        Set the time of a timer, pending or not.

        Raises:
            ValueError: The time is not a number; infinite is never.
        """
        if when_s != when_s:  # not a number
            raise ValueError("a timer's time must be a number, got nan")
        timer.when_s = when_s
        queued_s = timer._queued_s
        if queued_s is not None:
            if when_s >= queued_s:
                return
            self._count_stale()
        timer._queued_s = when_s
        heapq.heappush(self._heap, (when_s, timer.sequence, timer))

    def cancel(self, timer: Timer) -> None:
        """Take a timer out; its entry stays until it comes up or the queue is swept."""
        if timer._queued_s is not None:
            timer._queued_s = None
            self._count_stale()

    def earliest_s(self) -> float:
        """Return when the next timer fires; infinite without one."""
        heap = self._heap
        while heap:
            queued_s, sequence, timer = heap[0]
            if timer._queued_s != queued_s:
                heapq.heappop(heap)
                self._stale -= 1
            elif timer.when_s > queued_s:
                timer._queued_s = timer.when_s
                heapq.heapreplace(heap, (timer.when_s, sequence, timer))
            else:
                return queued_s
        return math.inf

    def pop_due(self, now_s: float) -> Timer | None:
        """Take out and return the first timer that is due; None if none is."""
        # An entry is never later than its timer, so a first entry to come needs no closer look.
        heap = self._heap
        if not heap or heap[0][0] > now_s or self.earliest_s() > now_s:
            return None
        timer = heapq.heappop(self._heap)[2]
        timer._queued_s = None
        return timer

    def clear(self) -> None:
        """Cancel every timer."""
        for _, _, timer in self._heap:
            timer._queued_s = None
        self._heap.clear()
        self._stale = 0

    def _count_stale(self) -> None:
        self._stale += 1
        if self._stale > STALE_MAX and self._stale * 2 > len(self._heap):
            live = {
                timer.sequence: entry
                for entry in self._heap
                if (timer := entry[2])._queued_s == entry[0]
            }
            self._heap = list(live.values())
            heapq.heapify(self._heap)
            self._stale = 0
