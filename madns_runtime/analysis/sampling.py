"""Thinning samples for drawing, and counting all of them for histograms and root mean squares. Pure numpy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.breaks import NOWHERE, gap_starts, wrap_starts
from madns_runtime.analysis.values import Floats, Histogram, Series, Tone

LEVELS = 240
BUCKETS_MAX = 300
SAMPLES_PER_BUCKET = 300
QUANTILES = (0.5, 0.99)
POINTS_PER_FIGURE = 40_000
POINTS_PER_SERIES_MAX = 1500
POINTS_PER_SERIES_MIN = 60
SERIES_PER_FIGURE = POINTS_PER_FIGURE // POINTS_PER_SERIES_MIN
"""More would have fewer points each than tell anything, or make a page that no browser shows."""
POINTS_PER_WRAP = 6
"""With fewer to each turn of an angle its lines are no more than strokes: points tell more."""
RMS_BINS = 12
"""Stretches of time, unless it is said otherwise."""
Stretch = tuple[float, float, float]
"""Its end, s; rms and largest value in it."""


def as_array(values: NDArray[Any]) -> Floats:
    """Return a column as floats; what is no number becomes NaN."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float64)
    numbers = [v if isinstance(v, int | float) else np.nan for v in values.tolist()]
    return np.array(numbers, dtype=np.float64)


def as_rows(columns: Mapping[str, NDArray[Any]], names: Iterable[str]) -> Floats:
    """Return columns beside each other as floats, a row per record, shape (N, M)."""
    return np.column_stack([as_array(columns[name]) for name in names])


def largest_size(values: Floats) -> float | None:
    """Return the largest absolute value of those that are finite; None without any."""
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size else None


def points_per_series(count: int) -> int:
    """Return how many points each of so many series may have, so that a page stays small."""
    share = POINTS_PER_FIGURE // max(count, 1)
    return max(min(share, POINTS_PER_SERIES_MAX), POINTS_PER_SERIES_MIN)


def thin(x: Floats, y: Floats, points_max: int) -> tuple[Floats, Floats]:
    """
    Keep the smallest and the largest sample of each of points_max / 2 buckets, in their order.

    No peak is lost. What is not finite marks a gap and is kept where a whole bucket is none.

    Args:
        x: Abscissae, shape (N,).
        y: Ordinates, shape (N,).
        points_max: Largest number of points returned; at least 2.
    """
    if len(y) <= points_max:
        return x, y
    edges = np.linspace(0, len(y), max(points_max // 2, 1) + 1).astype(np.int64)
    starts = edges[:-1]
    bucket = np.repeat(np.arange(len(starts)), np.diff(edges))
    # Sorted by bucket, then value; NaN sorts last, so the last finite value is looked up by count.
    is_finite = np.isfinite(y)
    order = np.lexsort((np.where(is_finite, y, np.nan), bucket))
    finite = np.add.reduceat(is_finite, starts)
    lowest = order[starts]
    highest = order[starts + np.maximum(finite, 1) - 1]
    chosen = np.unique(np.concatenate((lowest, highest)))
    return x[chosen], y[chosen]


def with_breaks(x: Floats, y: Floats, starts: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """
    Put a sample of NaN before each of some: no line is drawn to it from the one before.

    Args:
        x: Abscissae, shape (N,); of a break it is that of the sample behind it.
        y: Ordinates, shape (N,) or (N, M).
        starts: Numbers of samples.
    """
    if not len(starts):
        return x, y
    return np.insert(x, starts, x[starts]), np.insert(y, starts, np.nan, axis=0)


def with_gaps(pieces: Sequence[Floats]) -> Floats:
    """Return lines in space, each of shape (N, 3), as one with a point of NaN behind each."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([part for piece in pieces for part in (piece, gap)])


def thin_pieces(
    x: Floats, y: Floats, starts: NDArray[np.int64], points_max: int
) -> tuple[Floats, Floats]:
    """Thin as `thin` does, each piece that begins at one of *starts* by itself, with a break before it."""
    pieces = list(zip(np.split(x, starts), np.split(y, starts), strict=True))
    room = points_max - len(starts)
    thinned = [thin(*piece, max(room * len(piece[0]) // max(len(x), 1), 2)) for piece in pieces]
    heads = np.cumsum([len(piece[0]) for piece in thinned])[:-1]
    joined = [np.concatenate(columns) for columns in zip(*thinned, strict=True)]
    return with_breaks(joined[0], joined[1], heads)


def drawn_series(
    series: Series, points_max: int, *, unit: str = "", returns: NDArray[np.int64] = NOWHERE
) -> Series:
    """
    Return a series as a figure shows it: thinned, its line broken at gaps, wraps and *returns*.

    Args:
        series: All samples, in the order of their abscissae. Steps hold over a gap.
        points_max: Number of points that it may have, besides those of the breaks.
        unit: Of its ordinates: angles wrap.
        returns: Numbers of the samples with which one that was away goes on.
    """
    x, y = series.x, series.y
    wraps = wrap_starts(y, unit)
    if "points" not in series.form and POINTS_PER_WRAP * len(wraps) > points_max:
        series = replace(series, form="points")
    if series.form == "points":
        x, y = thin(x, y, points_max)
        return replace(series, x=x, y=y)
    gaps = NOWHERE if series.form == "steps" else gap_starts(x, points_max)
    starts = np.unique(np.concatenate((returns, gaps, wraps)))
    x, y = thin_pieces(x, y, starts, points_max)
    return replace(series, x=x, y=y)


def broken_at_gaps(series: Series) -> Series:
    """Return a series over time with its line broken at gaps that it shows no break at; all its samples stay."""
    if series.form in ("points", "steps"):
        return series
    starts = gap_starts(series.x, len(series.x))
    is_there = np.isfinite(series.y)
    starts = starts[is_there[starts] & is_there[starts - 1]]
    x, y = with_breaks(series.x, series.y, starts)
    return replace(series, x=x, y=y) if len(starts) else series


def evenly(count: int, points_max: int) -> NDArray[np.int64]:
    """Return indices of at most *points_max* of *count* samples, evenly spread, both ends included."""
    if count <= points_max:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, points_max).round().astype(np.int64))


class TimeEnvelope:
    """
    Median, p99 and largest value by bucket of time, over all samples of all agents.

    The quantiles come from a histogram with bins 4 % wide, the largest value is exact.

    Args:
        end_s: Largest time that will come, s.
        low: Smallest value told apart.
        high: Largest value told apart.
        samples: How many will come: buckets of time are made so wide that a p99 in them means something.
    """

    def __init__(self, end_s: float, low: float, high: float, *, samples: int) -> None:
        buckets = min(max(samples // SAMPLES_PER_BUCKET, 10), BUCKETS_MAX)
        self._edges_s = np.linspace(0.0, max(end_s, 1e-9), buckets + 1)
        high = max(high, low * 10)
        self._levels = np.geomspace(low, high, LEVELS + 1)
        self._counts = np.zeros((buckets, LEVELS), dtype=np.int64)
        self._largest = np.full(buckets, -np.inf)

    def add(self, t_s: Floats, values: Floats) -> None:
        """Count samples, shape (N,) each; where either is NaN there is none."""
        t_s, values = _told(t_s, values)
        buckets, levels = self._counts.shape
        row = np.clip(np.searchsorted(self._edges_s, t_s, "right") - 1, 0, buckets - 1)
        column = np.clip(np.searchsorted(self._levels, values, "right") - 1, 0, levels - 1)
        flat = np.bincount(row * levels + column, minlength=buckets * levels)
        self._counts += flat.reshape(buckets, levels)
        np.maximum.at(self._largest, row, values)

    def curves(self) -> tuple[Floats, dict[str, Floats]]:
        """Return the buckets' middles, s, and the curves p50, p99 and max; empty buckets are left out."""
        totals = self._counts.sum(axis=1)
        has = totals > 0
        middles = ((self._edges_s[1:] + self._edges_s[:-1]) / 2)[has]
        cumulated = np.cumsum(self._counts[has], axis=1)
        curves = {}
        for quantile in QUANTILES:
            reached = cumulated >= (quantile * totals[has])[:, None]
            level = self._levels[reached.argmax(axis=1) + 1]
            curves[f"p{quantile * 100:g}"] = np.minimum(level, self._largest[has])
        curves["max"] = self._largest[has]
        return middles, curves


def envelope_series(envelope: TimeEnvelope) -> list[Series]:
    """Return an envelope's curves, the largest behind, the median in front."""
    middles, curves = envelope.curves()
    tones: dict[str, Tone] = {"max": "pale", "p99": "warm", "p50": "main"}
    marks = [Series(x=middles, y=curves[n], name=n, tone=tone) for n, tone in tones.items()]
    return [drawn_series(mark, POINTS_PER_SERIES_MAX) for mark in marks]


def _told(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return the samples without those that are NaN, as what was not recorded is: they lie in no bin."""
    is_told = ~(np.isnan(t_s) | np.isnan(values))
    return (t_s, values) if is_told.all() else (t_s[is_told], values[is_told])


class BinCounts:
    """Counts in fixed bins; what lies outside goes into the outermost ones, and NaN into none."""

    def __init__(self, edges: Floats) -> None:
        self.edges = edges
        self.counts = np.zeros(len(edges) - 1, dtype=np.int64)

    def add(self, values: NDArray[Any]) -> None:
        """Count samples, shape (N,)."""
        if values.dtype.kind == "f":
            values = values[~np.isnan(values)]
        bins = np.clip(np.searchsorted(self.edges, values, "right") - 1, 0, len(self.counts) - 1)
        self.counts += np.bincount(bins, minlength=len(self.counts))

    def mark(self) -> Histogram:
        """Return the counts as a figure shows them."""
        return Histogram(edges=self.edges, counts=self.counts.astype(np.float64))


class BinnedRms:
    """
    Root mean square and largest value of something over time, in stretches of it.

    Args:
        duration_s: Where the last one ends, s.
        bins: How many there are.
    """

    def __init__(self, duration_s: float, bins: int = RMS_BINS) -> None:
        self._bins = bins
        self._edges_s = np.linspace(0.0, max(duration_s, 1e-9), bins + 1)
        self._counts = np.zeros(bins, dtype=np.int64)
        self._squares = np.zeros(bins)
        self._largest = np.zeros(bins)

    def add(self, t_s: Floats, values: Floats) -> None:
        """Take values, shape (N,), at times, s; where either is NaN there is none."""
        t_s, values = _told(t_s, values)
        bins = np.clip(np.searchsorted(self._edges_s, t_s, "right") - 1, 0, self._bins - 1)
        self._counts += np.bincount(bins, minlength=self._bins)
        with np.errstate(over="ignore"):  # what diverged has no mean square
            self._squares += np.bincount(bins, weights=values * values, minlength=self._bins)
        np.maximum.at(self._largest, bins, np.abs(values))

    def rows(self) -> list[Stretch]:
        """Return end of the stretch, s, rms and largest value of each that has any."""
        rms = np.sqrt(self._squares / np.maximum(self._counts, 1))
        columns = zip(self._edges_s[1:], rms, self._largest, self._counts, strict=True)
        return [(float(t), float(r), float(m)) for t, r, m, count in columns if count]
