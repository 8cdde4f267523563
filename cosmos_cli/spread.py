"""The size of something over time: rms and largest value in stretches of it. Pure numpy."""

from __future__ import annotations

import numpy as np

from cosmos_cli.report.sampling import Floats

BINS = 24
"""Stretches of time in which differences are told."""
Stretch = tuple[float, float, float]
"""Its end, s; rms and largest value in it."""


class Spread:
    """Root mean square and largest value of something over time, in stretches of it."""

    def __init__(self, duration_s: float) -> None:
        self._edges_s = np.linspace(0.0, max(duration_s, 1e-9), BINS + 1)
        self._counts = np.zeros(BINS, dtype=np.int64)
        self._squares = np.zeros(BINS)
        self._largest = np.zeros(BINS)

    def add(self, t_s: Floats, values: Floats) -> None:
        """Take values, shape (N,), at times, s."""
        bins = np.clip(np.searchsorted(self._edges_s, t_s, "right") - 1, 0, BINS - 1)
        self._counts += np.bincount(bins, minlength=BINS)
        self._squares += np.bincount(bins, weights=values * values, minlength=BINS)
        np.maximum.at(self._largest, bins, np.abs(values))

    def rows(self) -> list[Stretch]:
        """Return end of the stretch, s, rms and largest value of each that has any."""
        rms = np.sqrt(self._squares / np.maximum(self._counts, 1))
        columns = zip(self._edges_s[1:], rms, self._largest, self._counts, strict=True)
        return [(float(t), float(r), float(m)) for t, r, m, count in columns if count]
