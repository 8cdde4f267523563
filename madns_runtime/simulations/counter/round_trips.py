"""Round trips in whole microseconds, counted by value: exact statistics of any number in bounded memory."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.quantiles import quantile_of

COUNTED_US = 65_536
"""Round trips below this, us, have a place of their own in an array: 4 bytes each."""
LONG_VALUES_MAX = 4096
"""Different values of longer (or negative) ones that are told apart; what is more is left out and said."""


class RoundTrips:
    """
    Counts round trips by their value.

    A run of 8 h at 100 Hz has millions of samples but few values: samples kept one by one grow with the
    run, and all agents sort theirs at the same moment, its end.
    """

    __slots__ = ("_counts", "_long", "left_out")

    def __init__(self) -> None:
        self._counts = array("I", bytes(4 * COUNTED_US))
        self._long: dict[int, int] = {}
        self.left_out = 0
        """Samples that are in no statistics: there were more than LONG_VALUES_MAX different long ones."""

    def add(self, round_trip_us: int) -> None:
        """Count one; called for every packet."""
        if 0 <= round_trip_us < COUNTED_US:
            self._counts[round_trip_us] += 1
        else:
            self._add_long(round_trip_us)

    def statistics(self) -> dict[str, float] | None:
        """Return mean, sd, min, max, range, p50, p99, p999 over all samples, us; None if there are none."""
        values, counts = self._values()
        if not values.size:
            return None
        count = int(counts.sum())
        mean = float(values @ counts) / count
        variance = float(counts @ (values - mean) ** 2) / count
        low, high = float(values[0]), float(values[-1])
        reached = np.cumsum(counts)
        figures = {
            "mean": mean,
            "sd": math.sqrt(variance),
            "min": low,
            "max": high,
            "range": high - low,
            "p50": quantile_of(values, reached, 0.5),
            "p99": quantile_of(values, reached, 0.99),
            "p999": quantile_of(values, reached, 0.999),
        }
        return {name: round(value, 3) for name, value in figures.items()}

    def _add_long(self, round_trip_us: int) -> None:
        long = self._long
        if round_trip_us in long or len(long) < LONG_VALUES_MAX:
            long[round_trip_us] = long.get(round_trip_us, 0) + 1
        else:
            self.left_out += 1

    def _values(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the values that occurred, ascending, us, and how often each did."""
        counted = np.frombuffer(self._counts, dtype=np.uint32)
        (short,) = np.nonzero(counted)
        long = sorted(self._long)
        below = [value for value in long if value < 0]
        above = long[len(below) :]
        values = np.concatenate((below, short, above)).astype(np.float64)
        counts: list[Any] = [
            [self._long[value] for value in below],
            counted[short],
            [self._long[value] for value in above],
        ]
        return values, np.concatenate(counts).astype(np.int64)
