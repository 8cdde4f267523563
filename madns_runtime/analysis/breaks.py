"""Where a line through samples would show what was not: gaps in their times, and angles that wrap. Pure numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.values import Floats

GAP_PERIODS = 2.5
"""Periods from one sample to the next that are a gap: one sample that is missing alone is none."""
REGULAR_PERIODS = 1.5
REGULAR_SHARE = 0.9
"""Share of samples at most so many periods behind the one before, from which on they have a period at all."""
SAMPLES_MIN = 8
"""With fewer it is not known what their period is."""
POINTS_OF_GAP = 4
"""A gap that is narrower than so many of the points drawn cannot be seen."""
TURNS = {"deg": 360.0, "°": 360.0, "rad": 2.0 * np.pi}
"""A whole turn by the unit of an angle."""
TURN_TOLERANCE = 1e-6
NOWHERE: NDArray[np.int64] = np.empty(0, dtype=np.int64)


def gap_starts(x: Floats, points_max: int) -> NDArray[np.int64]:
    """
    Return the numbers of the samples that end a gap; none of samples that come irregularly, as events do.

    Args:
        x: Times, shape (N,), ascending.
        points_max: Number of points that will be drawn; at most a quarter of it are returned.
    """
    steps = np.diff(x)
    forward = steps[steps > 0.0]
    if len(x) < SAMPLES_MIN or not len(forward):
        return NOWHERE
    period = float(np.median(forward))
    if np.mean(forward <= REGULAR_PERIODS * period) < REGULAR_SHARE:
        return NOWHERE
    # Beside a gap samples come as ever: where the rate alone is another from then on, there is none.
    around = np.pad(steps, 1, constant_values=np.inf)
    beside = np.minimum(around[:-2], around[2:])
    width_min = max(GAP_PERIODS * period, POINTS_OF_GAP * float(forward.sum()) / points_max)
    return np.flatnonzero((steps > width_min) & (beside <= steps / 2.0)) + 1


def wrap_starts(y: Floats, unit: str) -> NDArray[np.int64]:
    """
    Return the numbers of the samples that come after an angle's wrap, such as from 360 deg to 0.

    Args:
        y: Values, shape (N,).
        unit: Theirs; what is no angle, or goes on beyond a turn, does not wrap.
    """
    turn = TURNS.get(unit)
    there = np.flatnonzero(np.isfinite(y))
    if turn is None or not len(there):
        return NOWHERE
    angles = y[there]
    beyond = turn * TURN_TOLERANCE
    low, high = float(angles.min()), float(angles.max())
    is_positive = low >= -beyond and high <= turn + beyond
    is_signed = low >= -turn / 2.0 - beyond and high <= turn / 2.0 + beyond
    if not (is_positive or is_signed):
        return NOWHERE
    return there[1:][np.abs(np.diff(angles)) > turn / 2.0]
