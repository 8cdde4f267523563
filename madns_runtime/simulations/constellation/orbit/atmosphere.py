"""
The upper atmosphere, the same everywhere at a height, and its drag. Pure: truth and accelerometers share it.

Between the base heights of a table density falls exponentially, so that it is continuous: steps of
an integrator see no jump. Sun and season are left out, which at solar maximum is a factor of ten at
500 km.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_FLATTENING,
    EARTH_RATE_RAD_S,
)

BASES = (
    (0.0, 1.225),
    (25.0, 3.899e-2),
    (30.0, 1.774e-2),
    (40.0, 3.972e-3),
    (50.0, 1.057e-3),
    (60.0, 3.206e-4),
    (70.0, 8.770e-5),
    (80.0, 1.905e-5),
    (90.0, 3.396e-6),
    (100.0, 5.297e-7),
    (110.0, 9.661e-8),
    (120.0, 2.438e-8),
    (130.0, 8.484e-9),
    (140.0, 3.845e-9),
    (150.0, 2.070e-9),
    (180.0, 5.464e-10),
    (200.0, 2.789e-10),
    (250.0, 7.248e-11),
    (300.0, 2.418e-11),
    (350.0, 9.518e-12),
    (400.0, 3.725e-12),
    (450.0, 1.585e-12),
    (500.0, 6.967e-13),
    (600.0, 1.454e-13),
    (700.0, 3.614e-14),
    (800.0, 1.170e-14),
    (900.0, 5.245e-15),
    (1000.0, 3.019e-15),
)
"""
Height, km, and density there, kg/m^3.

Source: Vallado, Fundamentals of Astrodynamics, 4th ed., table 8-4: US Standard Atmosphere at the
ground, CIRA-72 from 25 km, with an exospheric temperature of 1000 K from 500 km. The scale heights
that these densities give agree with the table's own to 0.006 % from 25 km up.
"""
TOP_SCALE_HEIGHT_M = 268_000.0
"""Scale height from the last base on, m; same source."""

HEIGHTS_M = np.array([height_km * 1000.0 for height_km, _ in BASES])
"""Base heights, shape (28,), m."""
DENSITIES_KG_M3 = np.array([density for _, density in BASES])
"""Densities at the bases, shape (28,), kg/m^3."""
SCALE_HEIGHTS_M = np.append(
    np.diff(HEIGHTS_M) / -np.diff(np.log(DENSITIES_KG_M3)), TOP_SCALE_HEIGHT_M
)
"""Scale heights above the bases, shape (28,), m."""
_BENDS_1_M = np.abs(np.diff(1.0 / SCALE_HEIGHTS_M))
KINKS_1_M = np.maximum(np.append(0.0, _BENDS_1_M), np.append(_BENDS_1_M, 0.0))
"""Change of the slope of log density at the base or the top of each layer, the larger one, shape (28,), 1/m."""
KINK_M_S = 1e-6
"""Error of velocity that one step over a kink may make at most, m/s: density has no second derivative there, and an
integrator of eighth order errs by its square of the step, unseen by its own estimate. Measured at a tenth of that."""
STEP_S_MIN = 0.5
"""No kink asks for shorter steps."""


def drag_m_s2(
    r: NDArray[np.float64],
    r2: NDArray[np.float64],
    v: NDArray[np.float64],
    *,
    ballistic_m2_kg: NDArray[np.float64] | float,
    radius_m: float,
) -> NDArray[np.float64]:
    """
    Return the acceleration by drag in an atmosphere that turns with the Earth.

    Args:
        r: Positions, shape (3, N), m; z along the Earth's axis.
        r2: Their squares, shape (N,), m^2.
        v: Velocities, shape (3, N), m/s, inertial.
        ballistic_m2_kg: B = Cd A / m, one for all or shape (N,), m^2/kg.
        radius_m: The Earth's equatorial radius, m.

    Returns:
        Shape (3, N), m/s^2, inertial.

    Source: a = -B rho |w| w / 2 with w the velocity relative to the air.
    """
    wind = v.copy()
    wind[0] += EARTH_RATE_RAD_S * r[1]
    wind[1] -= EARTH_RATE_RAD_S * r[0]
    density = density_kg_m3(height_m(r, r2, radius_m))
    speed = np.sqrt(np.einsum("in,in->n", wind, wind))
    return np.asarray((-0.5 * ballistic_m2_kg * density * speed) * wind)


def kink_step_s(
    r: NDArray[np.float64],
    v: NDArray[np.float64],
    ballistic_m2_kg: float | NDArray[np.float64],
    radius_m: float,
    *,
    step_s_max: float,
) -> float:
    """
    Return the longest step with which nobody's integration feels the kinks of the density, s.

    Args:
        r: Positions, shape (3, N), m; z along the Earth's axis.
        v: Velocities, shape (3, N), m/s, inertial.
        ballistic_m2_kg: B = Cd A / m, one for all or shape (N,), m^2/kg.
        radius_m: The Earth's equatorial radius, m.
        step_s_max: What is allowed without drag.

    A kink changes the slope of the drag in time by drag x climb x change of 1/H; integrated twice over a
    step, that is the velocity which may be missed.
    """
    r2 = np.einsum("in,in->n", r, r)
    climb = np.abs(np.einsum("in,in->n", r, v)) / np.sqrt(r2)
    # The lowest that a step may reach: whoever descends steeply is in denser air at its end.
    heights = np.maximum(height_m(r, r2, radius_m) - climb * step_s_max, 0.0)
    layer = np.searchsorted(HEIGHTS_M, heights, side="right") - 1
    density = density_kg_m3(heights)
    drag = 0.5 * ballistic_m2_kg * density * np.einsum("in,in->n", v, v)
    change_m_s3 = float((drag * climb * KINKS_1_M[layer]).max())
    if change_m_s3 * step_s_max**2 <= 2.0 * KINK_M_S:
        return step_s_max
    return min(step_s_max, max(STEP_S_MIN, math.sqrt(2.0 * KINK_M_S / change_m_s3)))


def height_m(
    r: NDArray[np.float64], r2: NDArray[np.float64], radius_m: float
) -> NDArray[np.float64]:
    """
    Return heights above the Earth's ellipsoid, m.

    Args:
        r: Positions, shape (3, N), m; z along the Earth's axis.
        r2: Their squares, shape (N,), m^2.
        radius_m: Equatorial radius, m.

    Returns:
        Shape (N,). To first order in the flattening: up to 60 m off, a thousandth of the density.
    """
    return np.asarray(np.sqrt(r2) - radius_m * (1.0 - EARTH_FLATTENING * r[2] * r[2] / r2))


def density_kg_m3(heights_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return densities, kg/m^3, at *heights_m* of any shape, m; that of the ground below it."""
    above = np.maximum(heights_m, 0.0)
    layer = np.searchsorted(HEIGHTS_M, above, side="right") - 1
    fall = (above - HEIGHTS_M[layer]) / SCALE_HEIGHTS_M[layer]
    return np.asarray(DENSITIES_KG_M3[layer] * np.exp(-fall))
