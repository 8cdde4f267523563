"""A condition: which recorded value it looks at, and the bounds that it waits for. Values that travel to all agents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal

TIME = "t_s"
TICK = "tick"
AGENT = "agent"
HOST = "host"
"""Name of the host's half among those who record."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ValueBounds:
    """
    Bounds of a recorded value: of numbers, truth values counting as 0 and 1, or one text.

    A value that is not there, and one that is not a number where a number belongs, is neither within bounds nor
    outside of them: it never holds. Nor does one that is not finite, which is null on record.
    """

    low: float | None = None
    """None: none below."""
    high: float | None = None
    is_closed: bool = True
    """Whether the bounds themselves hold."""
    text: str | None = None
    """The one text that holds; then bounds do not count."""
    is_negated: bool = False
    """Whether every other value holds instead."""

    @classmethod
    def below(cls, high: float) -> ValueBounds:
        """Return the bounds of values less than *high*."""
        return cls(high=high, is_closed=False)

    @classmethod
    def above(cls, low: float) -> ValueBounds:
        """Return the bounds of values greater than *low*."""
        return cls(low=low, is_closed=False)

    @classmethod
    def within(cls, low: float, high: float) -> ValueBounds:
        """Return the bounds of values from *low* to *high*."""
        return cls(low=low, high=high)

    @classmethod
    def equals(cls, value: float | str, tolerance: float = 0.0) -> ValueBounds:
        """Return the bounds of one text, or of numbers that differ from *value* by at most *tolerance*, as they are written."""
        if isinstance(value, str):
            return cls(text=value)
        return cls(low=_sum(value, -tolerance), high=_sum(value, tolerance))

    def overlap(self, first: float, last: float) -> bool:
        """Tell whether some number from *first* to *last*, these included, lies within."""
        if self.text is not None:
            return True
        if self.is_closed:
            return (self.high is None or self.high >= first) and (
                self.low is None or self.low <= last
            )
        return (self.high is None or self.high > first) and (self.low is None or self.low < last)

    def hold_a_whole_number(self) -> bool:
        """Tell whether some whole number lies within; of bounds that nothing lies within, that is not the reason."""
        if self.low is None or self.high is None or self.low > self.high:
            return True
        return math.isinf(self.low) or math.ceil(self.low) <= self.high

    def negated(self) -> ValueBounds:
        """Return the bounds of every value that does not hold here."""
        return replace(self, is_negated=not self.is_negated)

    def holds(self, value: object) -> bool:
        """Tell whether a recorded value lies within."""
        return self.find(value) is True

    def find(self, value: object) -> bool | None:
        """Tell whether a recorded value lies within or outside; None of one that is neither."""
        if self.text is not None:
            return (value == self.text) is not self.is_negated if isinstance(value, str) else None
        if isinstance(value, str):  # where records are counted, whatever they hold
            is_counted = self.low is None and self.high is None
            return not self.is_negated if is_counted else None
        try:
            number = float(value)  # type: ignore[arg-type]  # numpy's numbers are none of Python's
        except (TypeError, ValueError):
            return None
        if not math.isfinite(number):
            return None
        is_within = (
            (self.low is None or number >= self.low) and (self.high is None or number <= self.high)
            if self.is_closed
            else (self.low is None or number > self.low)
            and (self.high is None or number < self.high)
        )
        return is_within is not self.is_negated


def _sum(first: float, second: float) -> float:
    """Return a sum of decimal numbers: 0.8 - 0.1 is 0.7, which is less than it in binary numbers."""
    if not second or not math.isfinite(first + second):
        return float(first + second)
    return float(Decimal(repr(float(first))) + Decimal(repr(float(second))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """Values that are waited for in one field of one stream, of each of some agents."""

    number: int
    """Its own in the run, by which messages and callers name it."""
    name: str
    """Of the expectation or the entry of the timeline that it belongs to."""
    stream: str
    field: str
    """Empty: each record counts as 1."""
    bounds: ValueBounds
    agents: tuple[str, ...] = ()
    """Names of those whose records count; of a stream of the host's half those that a field `agent` names, if it has one."""
    is_of_host: bool = False
    """Whether the host's half records the stream, not the agents."""
    for_s: float = 0.0
    """How long it must have held, s of simulated time."""
    times: int = 1
    """In how many records it must hold, with for_s 0."""
    from_s: float | None = None
    """Records before this simulated time do not count, s."""
    to_s: float | None = None
    """Records after it do not, either."""
    ends_run: bool = False
    """Whether the run ends when it is met: an expectation is broken."""

    @property
    def is_timed(self) -> bool:
        """Whether records count at some times alone."""
        return self.from_s is not None or self.to_s is not None

    def is_at(self, t_s: float | None) -> bool:
        """Tell whether a record of simulated time *t_s* counts; None, before it runs, counts as 0."""
        if t_s is None or math.isnan(t_s):
            t_s = 0.0
        return (self.from_s is None or t_s >= self.from_s) and (
            self.to_s is None or t_s <= self.to_s
        )


def conditions_of(source: str, conditions: Sequence[Condition]) -> tuple[Condition, ...]:
    """Return the conditions that *source*, an agent or `host`, evaluates."""
    return tuple(
        each
        for each in conditions
        if (each.is_of_host if source == HOST else not each.is_of_host and source in each.agents)
    )
