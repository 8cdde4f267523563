"""Numbers of the orders by which agents have faults inserted around their devices. Pure."""

from __future__ import annotations

from collections import deque
from typing import Final

ORDERS_FROM: Final = 1_000_000
"""Numbers of orders from here on are a timeline's: nobody waits for an answer."""
ENDS_MAX: Final = 1000
"""Ends of a device's faults that are remembered: an older one is repeated by nobody any more."""


def timeline_order(number: int, *, is_end: bool) -> int:
    """Return the number of the order to begin, or to end, a timeline's action of that number."""
    return ORDERS_FROM + 2 * number + is_end


class CarriedOutEnds:
    """
    Ends of a timeline's faults that were carried out on one device.

    An agent that returns is told anew what it may have missed, and several agents that share the device may each be told:
    a second time the end would clear faults that have begun since.
    """

    def __init__(self) -> None:
        self._numbers: deque[int] = deque(maxlen=ENDS_MAX)

    def is_repeated(self, number: int) -> bool:
        """Take note of an order, and tell whether it is an end that was carried out before."""
        if number < ORDERS_FROM:
            return False
        end = number | 1  # as ORDERS_FROM is even
        is_known = end in self._numbers
        if number == end and not is_known:
            self._numbers.append(end)
        elif number != end and is_known:  # another agent begins it late, and ends it in its turn
            self._numbers.remove(end)
        return number == end and is_known
