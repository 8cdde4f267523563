"""The ticks that flight software was asked and has not answered, and which of them an answer is for. Pure."""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

from madns_runtime.simulations.constellation.flight.interface.answers import (
    TIME_TOLERANCE_S,
    FlightAnswer,
)

UNANSWERED_MAX: Final = 64
"""Ticks under way to the program in real time; further ones are not sent and counted."""


class AskedTick(NamedTuple):
    """A tick whose report was sent."""

    sent_s: float
    """When, by the computer's clock."""
    t_s: float
    """Its simulated time."""


class AskedTicks:
    """
    Ticks without an answer, oldest first.

    Where the way to the software may lose what is sent, an answer that names its tick is for that one, though others of
    its protocol name none; and a tick whose time for an answer is over is given up: by an answer that names none, which
    would else be taken for it, and, if no more are to be sent, by one that is sent all the same, once per answer_s.

    Args:
        answer_s: Time for an answer, s.
        by_time: Whether answers name their tick; else they come one for each tick in order.
        may_lose: Whether what is sent may not arrive.
    """

    def __init__(self, answer_s: float, *, by_time: bool, may_lose: bool) -> None:
        self._answer_s = answer_s
        self._by_time = by_time
        self._may_lose = may_lose
        self._ticks: deque[AskedTick] = deque()
        self.unanswered = 0
        """Ticks that later ones were answered before, and those that were given up."""
        self.begun_s = -math.inf
        """Time of its first answer: what it had to do before that is no lateness of the ticks asked meanwhile."""

    def __len__(self) -> int:
        return len(self._ticks)

    @property
    def oldest(self) -> AskedTick:
        """The one that waits for longest; there must be one."""
        return self._ticks[0]

    def add(self, sent_s: float, t_s: float) -> None:
        """Expect an answer."""
        self._ticks.append(AskedTick(sent_s, t_s))

    def is_late(self, sent_s: float, now_s: float) -> bool:
        """Tell whether an answer that came now, to a tick that was sent at *sent_s*, would be late."""
        return now_s - max(sent_s, self.begun_s) > self._answer_s

    def count_overdue(self, now_s: float) -> int:
        """Return how many should have been answered by now."""
        return sum(self.is_late(tick.sent_s, now_s) for tick in self._ticks)

    def is_full(self, t_s: float) -> bool:
        """Tell whether the tick at simulated time *t_s* is not to be sent: by such times alone, as a rerun decides alike."""
        if len(self._ticks) < UNANSWERED_MAX:
            return False
        if not self._may_lose or t_s - self._ticks[-1].t_s <= self._answer_s:
            return True
        self._give_up()
        return False

    def find(self, answer: FlightAnswer, now_s: float) -> AskedTick | None:
        """Return the tick that an answer is for, and forget it and those before; None for an answer to nothing."""
        if self._is_named(answer):
            times_s = enumerate(tick.t_s for tick in self._ticks)
            places = (at for at, t_s in times_s if abs(t_s - answer.t_s) <= TIME_TOLERANCE_S)
            place = next(places, None)
            if place is None:
                return None
            for _ in range(place):
                self._give_up()
        elif self._may_lose and self.begun_s > -math.inf:
            while len(self._ticks) > 1 and self.is_late(self._ticks[0].sent_s, now_s):
                self._give_up()
        return self._ticks.popleft() if self._ticks else None

    def must_be_asked(self, answer: FlightAnswer) -> bool:
        """Tell whether an answer to nothing means that the software has lost count: none was lost before it."""
        return not self._is_named(answer) and not (self._may_lose and self.unanswered)

    def _is_named(self, answer: FlightAnswer) -> bool:
        return (self._by_time or self._may_lose) and isinstance(answer.t_s, int | float)

    def _give_up(self) -> None:
        self._ticks.popleft()
        self.unanswered += 1
