"""Sums of times as they are written: three times 0.1 s are 0.3 s, the time of a tick. Pure."""

from __future__ import annotations

from decimal import Decimal


def later_s(t_s: float, by_s: float, times: int = 1) -> float:
    """
    Return a time plus a number of periods, s, each taken for the shortest decimal number that it is read from.

    In binary numbers 0.1 + 2 * 0.1 is more than 0.3, so that what is due then would wait for the next tick.
    """
    return float(Decimal(repr(float(t_s))) + times * Decimal(repr(float(by_s))))
