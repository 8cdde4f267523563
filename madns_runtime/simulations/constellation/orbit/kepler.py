"""Kepler's equation for ellipses. Pure; angles in rad."""

from __future__ import annotations

import math

ITERATIONS_MAX = 50
"""Newton needs 3-6 from the starting value below; more means the input is not an ellipse."""

TOLERANCE_RAD = 1e-15


class ConvergenceError(ArithmeticError):
    """Kepler's equation was not solved within ITERATIONS_MAX."""


def solve_kepler(mean_anomaly_rad: float, eccentricity: float) -> float:
    """
    Return the eccentric anomaly E that solves M = E - e sin E.

    Args:
        mean_anomaly_rad: M, rad, any number of turns.
        eccentricity: e, 0 <= e < 1.

    Returns:
        E, rad, within half a turn of zero.

    Raises:
        ConvergenceError: Unsolved after ITERATIONS_MAX.

    Newton's method kept inside a bracket that always holds the root, so that it converges for
    every ellipse. Accuracy: |E - e sin E - M| of a few 1e-16 of a turn.
    """
    if not 0.0 <= eccentricity < 1.0:
        raise ConvergenceError(f"eccentricity: expected 0 <= e < 1, got {eccentricity!r}")
    m = math.remainder(mean_anomaly_rad, math.tau)
    low, high = m - eccentricity, m + eccentricity
    anomaly = m + eccentricity * math.sin(m)
    for _ in range(ITERATIONS_MAX):
        error = anomaly - eccentricity * math.sin(anomaly) - m
        if error > 0.0:
            high = anomaly
        else:
            low = anomaly
        step = error / (1.0 - eccentricity * math.cos(anomaly))
        following = anomaly - step
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - anomaly) <= TOLERANCE_RAD * max(1.0, abs(anomaly)):
            return following
        anomaly = following
    if high - low > 1e-12:
        raise ConvergenceError(f"M {mean_anomaly_rad!r} rad, e {eccentricity!r}: unsolved")
    return anomaly


def true_from_eccentric(eccentric_anomaly_rad: float, eccentricity: float) -> float:
    """Return the true anomaly, rad, within half a turn of zero."""
    half = 0.5 * eccentric_anomaly_rad
    return 2.0 * math.atan2(
        math.sqrt(1.0 + eccentricity) * math.sin(half),
        math.sqrt(1.0 - eccentricity) * math.cos(half),
    )


def mean_from_true(true_anomaly_rad: float, eccentricity: float) -> float:
    """Return the mean anomaly of an ellipse, rad, within half a turn of zero."""
    half = 0.5 * true_anomaly_rad
    eccentric = 2.0 * math.atan2(
        math.sqrt(1.0 - eccentricity) * math.sin(half),
        math.sqrt(1.0 + eccentricity) * math.cos(half),
    )
    return eccentric - eccentricity * math.sin(eccentric)
