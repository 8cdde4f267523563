"""The size of something over time: rms and largest value in stretches of it. Pure numpy."""

from __future__ import annotations

import numpy as np

from cosmos_cli.report.sampling import Floats

BINS = 12
"""Stretches of time, unless it is said otherwise."""
Stretch = tuple[float, float, float]
"""Its end, s; rms and largest value in it."""


class Spread:
    """
    Root mean square and largest value of something over time, in stretches of it.

    Args:
        duration_s: Where the last one ends, s.
        bins: How many there are.
    """

    def __init__(self, duration_s: float, bins: int = BINS) -> None:
        self._bins = bins
        self._edges_s = np.linspace(0.0, max(duration_s, 1e-9), bins + 1)
        self._counts = np.zeros(bins, dtype=np.int64)
        self._squares = np.zeros(bins)
        self._largest = np.zeros(bins)

    def add(self, t_s: Floats, values: Floats) -> None:
        """Take values, shape (N,), at times, s."""
        bins = np.clip(np.searchsorted(self._edges_s, t_s, "right") - 1, 0, self._bins - 1)
        self._counts += np.bincount(bins, minlength=self._bins)
        self._squares += np.bincount(bins, weights=values * values, minlength=self._bins)
        np.maximum.at(self._largest, bins, np.abs(values))

    def rows(self) -> list[Stretch]:
        """Return end of the stretch, s, rms and largest value of each that has any."""
        rms = np.sqrt(self._squares / np.maximum(self._counts, 1))
        columns = zip(self._edges_s[1:], rms, self._largest, self._counts, strict=True)
        return [(float(t), float(r), float(m)) for t, r, m, count in columns if count]
