"""Values that wait to be put out at their time. Pure."""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass
from typing import Any, Final

from madns_runtime.hardware.contract import Channel

WAITING_MAX: Final = 10_000
"""Values that may wait for their time; more are refused, and counted."""


@dataclass(frozen=True, slots=True, order=True)
class PendingWrite:
    """One value and when it is due; the earlier first, of one time in the order in which they came."""

    due_s: float
    """On this machine's monotonic clock, s."""
    order: int
    channel: str
    value: Any


class PendingWrites:
    """Values that wait, of all outputs of a device."""

    def __init__(self) -> None:
        self._heap: list[PendingWrite] = []
        self._orders = itertools.count()
        self.replaced = 0
        """Values that a newer one of their channel took the place of before they were put out."""

    def __len__(self) -> int:
        return len(self._heap)

    def add(self, channel: Channel, value: Any, due_s: float) -> bool:
        """
        Let a value wait; of a channel that passes the newest alone, all that are due no earlier give way.

        Returns:
            Whether there was room.
        """
        if channel.passing == "newest":
            kept = [
                each for each in self._heap if each.channel != channel.name or each.due_s < due_s
            ]
            if len(kept) != len(self._heap):
                self.replaced += len(self._heap) - len(kept)
                heapq.heapify(kept)
                self._heap = kept
        if len(self._heap) >= WAITING_MAX:
            return False
        heapq.heappush(self._heap, PendingWrite(due_s, next(self._orders), channel.name, value))
        return True

    def pop_due(self, now_s: float) -> PendingWrite | None:
        """Take out the earliest that is due by now; None if nothing is."""
        return heapq.heappop(self._heap) if self._heap and self._heap[0].due_s <= now_s else None

    def next_due_s(self) -> float:
        """Return when the next is due, s; infinity if nothing waits."""
        return self._heap[0].due_s if self._heap else math.inf

    def clear(self) -> int:
        """Forget all that waits, and return how many that were."""
        count = len(self._heap)
        self._heap.clear()
        return count
