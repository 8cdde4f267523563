"""Quantiles of counted samples. Light, for agents that make their own statistics, too: numpy alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def quantile_of(values: NDArray[np.float64], cumulated: NDArray[np.int64], share: float) -> float:
    """
    Return a quantile as numpy's default does: linear between the two nearest samples.

    Args:
        values: The different values, ascending, shape (N,).
        cumulated: How many samples are at most each value, shape (N,).
        share: Of all samples, 0 to 1.
    """
    position = share * (int(cumulated[-1]) - 1)
    low = math.floor(position)
    lower, upper = np.searchsorted(cumulated, (low, math.ceil(position)), "right")
    below, above = float(values[lower]), float(values[upper])
    part = position - low
    if math.isinf(above - below):  # they are farther apart than a float can tell
        return below * (1.0 - part) + above * part
    return below + part * (above - below)
