"""Statistics of one field of one agent, over batches of its records in order of recording. numpy alone."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.conditions.condition import ValueBounds

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Places = NDArray[np.int64]
P99 = 0.99
TIMES_KEPT = 4096
"""Times within bounds, the earliest, that settled keeps; it looks again where it should have kept others."""
OCCURRENCES_KEPT = 100_000
"""Times of an event that are kept, the first ones; the others are counted."""


Found = tuple[float | None, float | None]
"""A statistic, and the simulated time of it, s; None where there is none."""


class Accumulator(ABC):
    """One statistic."""

    def take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        """
        Take a batch; shape (N,) each, N at least 1.

        Args:
            t_s: Times, s.
            values: None of which is missing.
            places: Among all records of whoever recorded them: what tells the order of those of one time.
        """
        # What diverged has no statistic: inf or NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            self._take(t_s, values, places)

    def result(self) -> Found:
        """Return what all batches came to."""
        return self._found_now()

    @abstractmethod
    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None: ...

    @abstractmethod
    def _found_now(self) -> Found: ...


def holds(bounds: ValueBounds, values: NDArray[Any]) -> Flags:
    """Tell of each value whether it lies within bounds; see `ValueBounds.holds`."""
    if bounds.text is not None:
        found: Flags = _are(values, bounds.text) != bounds.is_negated
        return found
    numbers = as_numbers(values)
    within = np.ones(len(numbers), bool)
    if bounds.low is not None:
        within &= numbers >= bounds.low if bounds.is_closed else numbers > bounds.low
    if bounds.high is not None:
        within &= numbers <= bounds.high if bounds.is_closed else numbers < bounds.high
    held: Flags = (within != bounds.is_negated) & np.isfinite(numbers)
    return held


def as_numbers(values: NDArray[Any]) -> Floats:
    """Return values as numbers: NaN where one is none, such as a text in a field whose kind nobody declared."""
    if values.dtype != object:
        return values.astype(np.float64)
    return np.array(
        [each if isinstance(each, int | float) else math.nan for each in values.tolist()], float
    )


def excess(bounds: ValueBounds, values: Floats) -> Floats:
    """Return how far values are beyond bounds; negative within."""
    found = np.full(len(values), -np.inf)
    if bounds.low is not None:
        found = np.maximum(found, bounds.low - values)
    if bounds.high is not None:
        found = np.maximum(found, values - bounds.high)
    return found


class Worst(Accumulator):
    """The value farthest beyond its bounds: of the greatest or least values, too."""

    def __init__(self, bounds: ValueBounds) -> None:
        self._bounds = bounds
        self._excess = -math.inf
        self._found: Found = (None, None)

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        numbers = values.astype(np.float64)
        beyond = excess(self._bounds, numbers)
        at = int(np.argmax(beyond))
        if beyond[at] > self._excess or self._found[0] is None:
            self._excess = float(beyond[at])
            self._found = float(numbers[at]), float(t_s[at])

    def _found_now(self) -> Found:
        return self._found


class Unlike(Accumulator):
    """The number of texts that are not the one that is expected, and the time of the first."""

    def __init__(self, bounds: ValueBounds) -> None:
        self._bounds = bounds
        self._count: int | None = None
        self._first_s: float | None = None

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        unlike = np.flatnonzero(~holds(self._bounds, values))
        self._count = (self._count or 0) + len(unlike)
        if len(unlike) and self._first_s is None:
            self._first_s = float(t_s[unlike[0]])

    def _found_now(self) -> Found:
        return self._count, self._first_s


class Last(Accumulator):
    """The last value; of a text, whether it is another than the one that is expected: 0 or 1."""

    def __init__(self, bounds: ValueBounds) -> None:
        self._bounds = bounds
        self._found: Found = (None, None)

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        if self._bounds.text is not None:
            value = float(not holds(self._bounds, values[-1:])[0])
        else:
            value = float(values[-1])
        self._found = value, float(t_s[-1])

    def _found_now(self) -> Found:
        return self._found


class Mean(Accumulator):
    """The mean, or the root of the mean square."""

    def __init__(self, power: int) -> None:
        self._power = power
        self._sum = 0.0
        self._count = 0

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        self._sum += float(np.sum(values.astype(np.float64) ** self._power))
        self._count += len(values)

    def _found_now(self) -> Found:
        if not self._count:
            return None, None
        mean = self._sum / self._count
        return (mean if self._power == 1 else math.sqrt(mean)), None


class StandardDeviation(Accumulator):
    """The root of the mean square of what differs from the mean (divided by N), by the means of batches: nothing cancels."""

    def __init__(self) -> None:
        self._count = 0
        self._mean = 0.0
        self._squares = 0.0

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        numbers = values.astype(np.float64)
        mean = float(np.mean(numbers))
        count = self._count + len(numbers)
        apart = mean - self._mean
        self._squares += float(np.sum((numbers - mean) ** 2))
        self._squares += apart * apart * self._count * len(numbers) / count
        self._mean += apart * len(numbers) / count
        self._count = count

    def _found_now(self) -> Found:
        return (math.sqrt(self._squares / self._count) if self._count else None), None


class Percentile99(Accumulator):
    """
    The least value that at least 99 % of all values do not exceed: exact.

    Args:
        records: The most that there may be: a hundredth of them is kept.
    """

    def __init__(self, records: int) -> None:
        self._kept_max = records - math.ceil(P99 * records) + 1
        self._kept: Floats = np.empty(0)
        self._count = 0

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        self._count += len(values)
        kept = np.concatenate((self._kept, values.astype(np.float64)))
        if len(kept) > self._kept_max:
            kept = np.partition(kept, len(kept) - self._kept_max)[-self._kept_max :]
        self._kept = kept

    def _found_now(self) -> Found:
        if not self._count:
            return None, None
        from_top = self._count - math.ceil(P99 * self._count)
        return float(np.sort(self._kept)[-1 - from_top]), None


class Counted(Accumulator):
    """
    How many records there are, or hold.

    Args:
        when: Bounds of those that count; None for all.
        per_s: What the number is divided by: 1, or a time, s, for a rate.
    """

    def __init__(self, when: ValueBounds | None, per_s: float = 1.0) -> None:
        self._when = when
        self._per_s = per_s
        self._count = 0

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        held = len(values) if self._when is None else np.count_nonzero(holds(self._when, values))
        self._count += int(held)

    def _found_now(self) -> Found:
        return (self._count / self._per_s if self._per_s > 0.0 else None), None


class FirstTime(Accumulator):
    """The earliest time at which the value lies within bounds."""

    def __init__(self, when: ValueBounds) -> None:
        self._when = when
        self._first_s: float | None = None
        self.place: int | None = None
        """Place of its record."""

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        held = np.flatnonzero(holds(self._when, values))
        if not len(held):
            return
        at = held[np.argmin(t_s[held])]
        if self._first_s is None or t_s[at] < self._first_s:
            self._first_s, self.place = float(t_s[at]), int(places[at])

    def _found_now(self) -> Found:
        return self._first_s, self._first_s


class Settled(Accumulator):
    """
    The time from which on the value stays within bounds until the last record, by their times.

    Records of one time follow each other as they were recorded. Some come late, such as a maneuver's, which is on record
    once truth holds it: times within bounds are kept until none can come before them.
    """

    def __init__(self, when: ValueBounds) -> None:
        self._when = when
        self._outside = (-math.inf, -1)
        """Time and place of the last one outside."""
        self._t_s: Floats = np.empty(0)
        """Times behind it, in order, and their places."""
        self._places: Places = np.empty(0, np.int64)
        self._left_out_s = (math.inf, -math.inf)
        """Earliest and latest of those within bounds that were not kept."""

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        within = holds(self._when, values)
        if not within.all():
            outside_s, their = t_s[~within], places[~within]
            last_s = outside_s.max()
            found = float(last_s), int(their[outside_s == last_s].max())
            self._outside = max(self._outside, found)
        elif len(self._t_s) == TIMES_KEPT and t_s.min() > self._t_s[-1]:
            self._leave_out(t_s)  # behind all that are kept, as most of a long run are
            return
        all_s = np.concatenate((self._t_s, t_s[within]))
        their = np.concatenate((self._places, places[within]))
        last_s, last_place = self._outside
        behind = (all_s > last_s) | ((all_s == last_s) & (their > last_place))
        all_s, their = all_s[behind], their[behind]
        order = np.lexsort((their, all_s))
        self._leave_out(all_s[order[TIMES_KEPT:]])
        order = order[:TIMES_KEPT]
        self._t_s, self._places = all_s[order], their[order]

    def _leave_out(self, t_s: Floats) -> None:
        if len(t_s):
            first_s, last_s = self._left_out_s
            self._left_out_s = min(first_s, float(t_s.min())), max(last_s, float(t_s.max()))

    @property
    def must_look_again(self) -> bool:
        """Whether the first one may be among those left out: a late one outside has come behind those kept."""
        first_s, last_s = self._left_out_s
        return last_s >= self._outside[0] and not (len(self._t_s) and self._t_s[0] <= first_s)

    def look_again(self) -> None:
        """Begin anew with what is known of those outside: all records come once more."""
        self._t_s, self._places = np.empty(0), np.empty(0, np.int64)
        self._left_out_s = (math.inf, -math.inf)

    def _found_now(self) -> Found:
        since_s = float(self._t_s[0]) if len(self._t_s) else None
        return since_s, since_s


class Occurrences(Accumulator):
    """The times of an event, s, and the places of its records, in order of recording."""

    def __init__(self, word: str) -> None:
        self._word = word
        self.count = 0
        self.found: list[tuple[float, int]] = []
        self._left_out_s = math.inf
        """Earliest of those that were not kept."""

    def _take(self, t_s: Floats, values: NDArray[Any], places: Places) -> None:
        found = np.flatnonzero(_are(values, self._word))
        self.count += len(found)
        kept, left_out = np.split(found, [OCCURRENCES_KEPT - len(self.found)])
        self._left_out_s = min([self._left_out_s, *t_s[left_out].tolist()])
        self.found += zip(t_s[kept].tolist(), places[kept].tolist(), strict=True)

    def is_open_at(self, latest_s: float | None) -> bool:
        """Tell whether some of the event that were not kept may be of times up to *latest_s*, None for any."""
        if self.count <= len(self.found):
            return False
        return latest_s is None or self._left_out_s <= latest_s

    def _found_now(self) -> Found:
        first_s = min((t_s for t_s, _ in self.found), default=None)
        return first_s, first_s


def _are(values: NDArray[Any], text: str) -> Flags:
    """Tell which values are this text; numbers never are."""
    if values.dtype != object:
        return np.zeros(len(values), bool)
    return np.array(values == text, bool)
