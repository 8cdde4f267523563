"""
A vehicle's receiver: holds messages until the moment they are heard. Pure, bounded.

The host hands messages over ahead of their time, so that the network between computers never decides
in which tick one is heard: simulated time alone does.
"""

from __future__ import annotations

import heapq

from madns_runtime.simulations.constellation.messages import Delivery

HELD_MAX = 4096
"""Messages held at a time; further ones are refused and counted."""
TIME_EPSILON_S = 1e-9
"""Rounding of tick times: what arrives at a tick's own time is heard in it."""


class Receiver:
    """Messages in the order in which they are heard: by time, then by sender."""

    def __init__(self) -> None:
        self.received = 0
        """Messages heard."""
        self.late = 0
        """Messages that came after the tick in which they ought to have been heard."""
        self.refused = 0
        """Messages for which there was no room."""
        self._held: list[tuple[float, str, float, int, Delivery]] = []
        self._tick_s = float("-inf")
        self._serial = 0

    @property
    def held(self) -> int:
        """Messages whose time has not come."""
        return len(self._held)

    def add(self, delivery: Delivery) -> None:
        """Take a message whose time is to come, or has come already: the latter is counted late."""
        if len(self._held) >= HELD_MAX:
            self.refused += 1
            return
        if delivery.arrives_s <= self._tick_s + TIME_EPSILON_S:
            self.late += 1
        self._serial += 1
        entry = (delivery.arrives_s, delivery.sender, delivery.sent_s, self._serial, delivery)
        heapq.heappush(self._held, entry)

    def due(self, t_s: float) -> list[Delivery]:
        """Return what is heard in the tick at *t_s*, in order, and forget it."""
        self._tick_s = t_s
        held, found = self._held, []
        while held and held[0][0] <= t_s + TIME_EPSILON_S:
            found.append(heapq.heappop(held)[-1])
        self.received += len(found)
        return found
