"""Ticks at which a stream has a record whose rate is another than theirs. Pure."""

from __future__ import annotations

from fractions import Fraction


class RecordedTicks:
    """
    The ticks that are nearest to the multiples of a period, which need be no whole number of ticks.

    Args:
        rate_hz: Of the records; one that is faster than the ticks' is theirs.
        tick_hz: Of the ticks.
    """

    def __init__(self, rate_hz: float, tick_hz: float) -> None:
        # As they are written in decimals: 0.1 is a tenth, so that records never drift against the ticks.
        period = max(Fraction(1), Fraction(repr(tick_hz)) / Fraction(repr(rate_hz)))
        self._numerator, self._denominator = period.as_integer_ratio()

    def after(self, tick: int) -> int:
        """Return the first of them after *tick*."""
        numerator, denominator = self._numerator, self._denominator
        number = -(-(2 * tick + 1) * denominator // (2 * numerator))
        return (2 * number * numerator + denominator) // (2 * denominator)
