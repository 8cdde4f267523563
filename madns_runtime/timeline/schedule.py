"""
When the entries of a timeline are due. Pure; chance is drawn under the run's seed.

Each draw hangs on the seed, the entry's place in the timeline, the agent's name and how many came before it alone:
another agent, or another entry behind it, changes none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Final

from madns_runtime.timeline.entries import ScheduledEntry
from madns_runtime.written_times import later_s

ACTIONS_MAX: Final = 10_000
"""Actions of one run that its timeline knows beforehand."""
SECONDS_PER_HOUR: Final = 3600.0
ROUNDING: Final = 1e-12
"""Of a quotient of times: 1.2 s are twelve times 0.1 s."""
_HALF_STEP: Final = 2.0**-54


@dataclass(frozen=True, slots=True)
class DueAction:
    """An action of an entry at its time."""

    t_s: float
    """Simulated time, s."""
    entry: int
    """The entry's place in the timeline, from 0."""
    agents: tuple[str, ...]


def schedule(
    entries: Sequence[ScheduledEntry], *, seed: int, duration_s: float
) -> tuple[DueAction, ...]:
    """
    Return all actions whose times are known before the run, by time; of one time in the order of the entries.

    Args:
        entries: Of the timeline.
        seed: The run's.
        duration_s: The run's; an action at its very end is none.

    Bounded: at most ACTIONS_MAX, the earliest.
    """
    found = [
        due
        for place, entry in enumerate(entries)
        for due in _due_of(place, entry, seed=seed, duration_s=duration_s)
    ]
    found.sort(key=lambda due: (due.t_s, due.entry))
    return tuple(found[:ACTIONS_MAX])


def count_expected(entry: ScheduledEntry, duration_s: float) -> float:
    """Return how many actions an entry has, drawn ones on average."""
    end_s = _end_s(entry, duration_s)
    if entry.every_s is not None:
        periods = (end_s - entry.from_s) / entry.every_s
        if math.isinf(periods):  # a period next to nothing
            return periods
        return max(0.0, math.floor(periods * (1.0 + ROUNDING)) + 1)
    if entry.rate_per_h is not None:
        length_h = max(0.0, end_s - entry.from_s) / SECONDS_PER_HOUR
        return entry.rate_per_h * length_h * max(1, len(entry.agents))
    return 1.0


def _end_s(entry: ScheduledEntry, duration_s: float) -> float:
    return duration_s if entry.to_s is None else min(entry.to_s, duration_s)


def _due_of(
    place: int, entry: ScheduledEntry, *, seed: int, duration_s: float
) -> Iterator[DueAction]:
    end_s = _end_s(entry, duration_s)
    if entry.at_s is not None:
        if entry.at_s < duration_s:
            yield DueAction(entry.at_s, place, entry.agents)
    elif entry.every_s is not None:
        for number in range(ACTIONS_MAX):
            t_s = later_s(entry.from_s, entry.every_s, number)
            if t_s > end_s or t_s >= duration_s:
                return
            yield DueAction(t_s, place, entry.agents)
    elif entry.rate_per_h is not None:
        for agent in entry.agents or ("",):
            own = (agent,) if agent else ()
            for t_s in _drawn(entry, end_s, key=f"{seed}/{place}/{agent}"):
                yield DueAction(t_s, place, own)


def _drawn(entry: ScheduledEntry, end_s: float, *, key: str) -> Iterator[float]:
    """Yield times of a Poisson process."""
    mean_s = SECONDS_PER_HOUR / (entry.rate_per_h or math.inf)
    t_s = entry.from_s
    for number in range(ACTIONS_MAX):
        digest = blake2b(f"timeline/{key}/{number}".encode(), digest_size=8).digest()
        t_s -= mean_s * math.log((int.from_bytes(digest) >> 11) * 2.0**-53 + _HALF_STEP)
        if t_s >= end_s:
            return
        yield t_s
