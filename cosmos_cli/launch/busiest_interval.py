"""
The network's inequality 2.10 as a maximum over any interval (thesis 2.5.3). Pure.

A message counts in an interval if it is sent in it and must have arrived by its end. The worst instant is the one at
which every agent sends one message of every kind, and after which each goes on at its rate: all are refilled, all
maneuver, all tick. An average over time would let that burst pass; it must get through as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter

POINTS_MAX = 4096
"""Interval lengths that are looked at; beyond, a bound stands for what a longer one could hold."""
ROUNDING = 1e-9
"""Times that differ by so small a share are the same, and so are counts that differ by so little."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sending:
    """Messages of one kind and of a number of senders."""

    name: str
    wire_bytes: float
    """Size of one message, all headers included."""
    rate_hz: float
    """Messages per second of each sender."""
    within_s: float
    """How long a message may be on its way."""
    senders_max: float = math.inf
    """Senders that there are at most, however many agents."""

    def senders(self, agents: float) -> float:
        """Return how many of the agents send these."""
        return min(agents, self.senders_max)

    def messages(self, length_s: float) -> int:
        """Return how many of one sender's messages an interval of that length has to carry at worst."""
        if length_s < self.within_s * (1.0 - ROUNDING):
            return 0
        # Ten tenths of a second add up to a little less than a second, in which messages of one per second count as well.
        return max(1, math.floor((length_s - self.within_s) * self.rate_hz + ROUNDING) + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class BusiestInterval:
    """The interval in which most has to be carried for its length."""

    length_s: float
    """Infinity if the average over a long time is the most."""
    bytes_s: float
    """Load within it, over its length."""


def busiest_interval(sendings: Sequence[Sending], agents: float) -> BusiestInterval:
    """
    Return the busiest interval of so many agents.

    It begins with everybody's message of every kind. With U the mean rate, what an interval of length L carries is at
    most U L + C, where C counts what a message that is urgent adds, and, of a length that is longer than any message may
    be on its way, what one that has time takes away. No interval longer than C / (best - U) can be busier than the best so far.
    """
    mean = sum(each.senders(agents) * each.wire_bytes * each.rate_hz for each in sendings)
    best = BusiestInterval(length_s=math.inf, bytes_s=mean)
    excesses = [_excess_bytes(each, agents) for each in sendings]
    latest_s = max((each.within_s for each in sendings), default=0.0)
    for count, length_s in enumerate(_lengths(sendings)):
        excess = math.fsum(each if length_s >= latest_s else max(0.0, each) for each in excesses)
        if length_s * (best.bytes_s - mean) >= excess:
            break
        if count >= POINTS_MAX:
            bound = mean + excess / length_s
            best = max(
                best, BusiestInterval(length_s=length_s, bytes_s=bound), key=attrgetter("bytes_s")
            )
            break
        carried = sum(e.senders(agents) * e.wire_bytes * e.messages(length_s) for e in sendings)
        here = BusiestInterval(length_s=length_s, bytes_s=carried / length_s)
        if here.bytes_s > best.bytes_s * (1.0 + 1e-12):
            best = here
    return best


def _excess_bytes(sending: Sending, agents: float) -> float:
    """Return what the senders' messages of a long interval are above the mean at most; negative if they have time."""
    share = 1.0 - sending.within_s * sending.rate_hz
    if abs(share) < ROUNDING:
        return 0.0
    return sending.senders(agents) * sending.wire_bytes * share


def _lengths(sendings: Sequence[Sending]) -> Iterator[float]:
    """Yield the lengths at which one message more must be carried, in order; at most one more than POINTS_MAX."""
    following = [[each.within_s, each.rate_hz] for each in sendings if each.within_s > 0.0]
    for _ in range(POINTS_MAX + 1):
        if not following:
            return
        length_s = min(each[0] for each in following)
        if not math.isfinite(length_s):
            return
        yield length_s
        for each in following:
            if each[0] <= length_s * (1.0 + 1e-12):
                each[0] = each[0] + 1.0 / each[1] if each[1] > 0.0 else math.inf
