"""One condition of one agent, followed through its records in order of time."""

from __future__ import annotations

import math

from madns_runtime.conditions.condition import Condition
from madns_runtime.written_times import later_s


class ConditionEvaluator:
    """
    Finds when a condition is met, once.

    Args:
        condition: What is waited for.
    """

    __slots__ = ("_since_s", "condition", "count", "is_met")

    def __init__(self, condition: Condition) -> None:
        self.condition = condition
        self.is_met = False
        self.count = 0
        """Records in which it held, those of earlier incarnations with them."""
        self._since_s: float | None = None

    def take(self, t_s: float | None, value: object) -> float | None:
        """
        Take one record's value.

        Args:
            t_s: The record's simulated time, s; None before it runs.
            value: Of the condition's field.

        Returns:
            The simulated time at which the condition is met by this record, s; None if it is not, or was before.
        """
        condition = self.condition
        if self.is_met or not condition.is_at(t_s):
            return None
        at_s = 0.0 if t_s is None else t_s
        is_within = condition.bounds.find(value)
        if is_within is None:
            return self.look(at_s)  # nothing is known of it: the value before is still the newest
        if not is_within:
            # Until this record the one before it was the newest: it may have held for long enough, with nobody looking.
            met_s = self.look(math.nextafter(at_s, -math.inf))
            self._since_s = None
            return met_s
        if self._since_s is None:
            self._since_s = at_s
        self.count += 1
        if condition.for_s > 0.0:
            return self.look(at_s)
        if self.count < condition.times:
            return None
        self.is_met = True
        return at_s

    @property
    def wants_earlier(self) -> bool:
        """Whether records of an earlier incarnation count, too, and there may be more of them."""
        return 1 < self.condition.times > self.count

    def recall(self, t_s: float | None, value: object) -> None:
        """Count the value of a record of an earlier incarnation; what it meets is met by the next one."""
        condition = self.condition
        if condition.times > 1 and condition.is_at(t_s):
            self.count += condition.bounds.holds(value)

    def look(self, now_s: float) -> float | None:
        """
        Take the newest value for that of *now_s*, too; a condition that is to hold for a while may be met by it.

        Returns:
            The simulated time from which on it has held for long enough, s; None if it has not.
        """
        since_s, for_s = self._since_s, self.condition.for_s
        if self.is_met or since_s is None or for_s <= 0.0:
            return None
        met_s = later_s(since_s, for_s)
        if now_s < met_s:
            return None
        self.is_met = True
        return met_s
