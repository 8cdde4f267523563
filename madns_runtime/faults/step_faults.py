"""Faults of one agent's steps: hung, or slow by a factor; several may be in force at a time. Pure."""

from __future__ import annotations

import math
from typing import Final

HANG: Final = "hang"
SLOW: Final = "slow"


class StepFaults:
    """The faults in force at one agent."""

    __slots__ = ("_factors", "_hangs", "withheld")

    def __init__(self) -> None:
        self._hangs = 0
        self._factors: list[float] = []
        self.withheld = 0
        """Ticks in which the agent was not stepped, since faults are in force."""

    def begin(self, word: str, factor: float = 1.0) -> None:
        """Put a fault in force: hang, or slow by *factor*."""
        if not self.are_in_force:
            self.withheld = 0
        if word == HANG:
            self._hangs += 1
        else:
            self._factors.append(factor)

    def end(self, word: str, factor: float = 1.0) -> None:
        """Lift a fault; one that is not in force is left alone."""
        if word == HANG:
            self._hangs = max(0, self._hangs - 1)
        elif factor in self._factors:
            self._factors.remove(factor)

    @property
    def are_in_force(self) -> bool:
        """Whether there is any."""
        return bool(self._hangs or self._factors)

    @property
    def is_hung(self) -> bool:
        """Whether no step is taken."""
        return self._hangs > 0

    @property
    def factor(self) -> float:
        """Factor by which steps are slower: that of the slowest fault in force."""
        return max(self._factors, default=1.0)

    def withholds(self, tick: int) -> bool:
        """Tell whether the step of *tick* is withheld where steps take no time, and count it; a slow agent takes one in so many."""
        is_withheld = self.is_hung or tick % math.ceil(self.factor) != 0
        self.withheld += is_withheld
        return is_withheld
