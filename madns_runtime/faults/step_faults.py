"""
Faults of one agent's steps: hung, or slow by a factor; several may be in force at a time. Pure.

They are told apart by the numbers of their actions: an agent that was started anew meanwhile has none of those before,
and what ends one of these leaves alone those that began after its return.
"""

from __future__ import annotations

import math

from madns_runtime.timeline.fault_kinds import HANG


class StepFaults:
    """The faults in force at one agent."""

    __slots__ = ("_factors", "withheld")

    def __init__(self) -> None:
        self._factors: dict[int, float] = {}
        """By the number of the action; infinite where no step is taken."""
        self.withheld = 0
        """Ticks in which the agent was not stepped, since faults are in force."""

    def begin(self, number: int, word: str, factor: float = 1.0) -> None:
        """Put a fault in force, that of an action's *number*: hang, or slow by *factor*."""
        if not self.are_in_force:
            self.withheld = 0
        self._factors[number] = math.inf if word == HANG else factor

    def end(self, number: int) -> bool:
        """Lift a fault; return whether it was in force here."""
        return self._factors.pop(number, None) is not None

    @property
    def are_in_force(self) -> bool:
        """Whether there is any."""
        return bool(self._factors)

    @property
    def is_hung(self) -> bool:
        """Whether no step is taken."""
        return math.inf in self._factors.values()

    @property
    def factor(self) -> float:
        """Factor by which steps are slower: that of the slowest fault in force; infinite where none is taken."""
        return max(self._factors.values(), default=1.0)

    def withholds(self, tick: int) -> bool:
        """Tell whether the step of *tick* is withheld where steps take no time, and count it; a slow agent takes one in so many."""
        factor = self.factor
        # Tick n is the next whole multiple of the factor, or the first after it: ten of eleven at 1.1.
        is_withheld = self.is_hung or tick // factor == (tick - 1) // factor
        self.withheld += is_withheld
        return is_withheld
