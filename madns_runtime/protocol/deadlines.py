"""Deadlines of SYNC messages: which were not acknowledged in time, each reported once."""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass
from typing import Final

from madns_runtime.protocol.counters import LinkCounters

BROKEN_UNREAD_MAX: Final = 1024
"""Reports kept for an owner that does not read them; the counter counts all."""

_NEVER: Final = float("inf")


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenDeadline:
    """A SYNC message that the peer did not acknowledge by its deadline."""

    index: int
    """0 for the first SYNC message of the link."""
    channel: int
    body: bytes
    sent_s: float
    deadline_s: float
    """Deadline on the clock of `sent_s`, this side's monotonic one."""
    late_s: float | None
    """Acknowledgement minus deadline; None if there was none when the deadline's timer came, or will be none."""


class DeadlineWatch:
    """The open deadlines of one link."""

    __slots__ = ("_broken", "_counters", "_heap", "_open")

    def __init__(self, counters: LinkCounters) -> None:
        self._counters = counters
        self._open: dict[int, tuple[float, float, int, bytes]] = {}  # by index, ascending
        self._heap: list[tuple[float, int]] = []
        self._broken: deque[BrokenDeadline] = deque(maxlen=BROKEN_UNREAD_MAX)

    def add(self, index: int, deadline_s: float, sent_s: float, message: tuple[int, bytes]) -> None:
        """Watch the message (channel, body) that was queued as number *index*."""
        self._open[index] = (deadline_s, sent_s, *message)
        heapq.heappush(self._heap, (deadline_s, index))

    def acknowledge(self, count: int, now_s: float) -> None:
        """Note that the peer has the first *count* SYNC messages."""
        while self._open:
            index = next(iter(self._open))
            if index >= count:
                return
            if now_s > self._open[index][0]:
                self._break(index, now_s - self._open[index][0])
            else:
                del self._open[index]

    def expire(self, now_s: float) -> None:
        """Report what is not acknowledged and past its deadline."""
        while self.get_timer() <= now_s:
            self._break(heapq.heappop(self._heap)[1], None)

    def give_up(self) -> None:
        """Report all that are open: their messages will not be acknowledged any more."""
        for index in list(self._open):
            self._break(index, None)

    def get_timer(self) -> float:
        """Return the next deadline, infinity if there is none."""
        heap = self._heap
        while heap and heap[0][1] not in self._open:
            heapq.heappop(heap)
        return heap[0][0] if heap else _NEVER

    def _break(self, index: int, late_s: float | None) -> None:
        deadline_s, sent_s, channel, body = self._open.pop(index)
        self._counters.deadlines_broken += 1
        self._broken.append(
            BrokenDeadline(
                index=index,
                channel=channel,
                body=body,
                sent_s=sent_s,
                deadline_s=deadline_s,
                late_s=late_s,
            )
        )

    def next_broken(self) -> BrokenDeadline | None:
        """Return the next unread report, oldest first."""
        return self._broken.popleft() if self._broken else None
