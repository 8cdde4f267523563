"""
The turning Earth: sidereal time, the WGS-84 ellipsoid, and places on it in the inertial frame. Pure.

TEME is turned into the Earth-fixed frame by Greenwich mean sidereal time alone, as element sets are
meant. Left out: polar motion (15 m at most on the ground) and UT1 - UTC (within 0.9 s, 420 m at the
equator, unless the caller knows UT1).
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_FLATTENING,
    EARTH_RADIUS_M,
    SECONDS_PER_DAY,
)

J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
_DAYS_PER_CENTURY = 36_525.0


def days_since_j2000(epoch: datetime, t_s: float = 0.0) -> float:
    """
    Return days from 2000-01-01 12:00 to *t_s* seconds after *epoch*, in the epoch's own time scale.

    Args:
        epoch: With a time zone. UTC stands for UT1: see the module.
        t_s: Seconds after it.
    """
    since = epoch - J2000
    return since.days + (since.seconds + since.microseconds * 1e-6 + t_s) / SECONDS_PER_DAY


def gmst_rad(days: float) -> float:
    """
    Return Greenwich mean sidereal time, rad within [0, 2 pi).

    Args:
        days: UT1 since 2000-01-01 12:00, days.

    Source: IAU 1982; Aoki et al., Astronomy and Astrophysics 105 (1982), 359.
    """
    t = days / _DAYS_PER_CENTURY
    # The whole turns of the days are left out before they cost digits.
    seconds = 67_310.54841 + (8_640_184.812866 + (0.093104 - 6.2e-6 * t) * t) * t
    turns = math.fmod(days, 1.0) + seconds / SECONDS_PER_DAY
    return math.tau * (turns % 1.0)


def gmst_rate_rad_s(days: float) -> float:
    """Return the rate of `gmst_rad` at the same argument, rad/s."""
    t = days / _DAYS_PER_CENTURY
    per_century = 8_640_184.812866 + (2.0 * 0.093104 - 3.0 * 6.2e-6 * t) * t
    return math.tau / SECONDS_PER_DAY * (1.0 + per_century / SECONDS_PER_DAY / _DAYS_PER_CENTURY)


def geodetic_to_fixed(
    latitude_rad: NDArray[np.float64],
    longitude_rad: NDArray[np.float64],
    altitude_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """
    Return places on the WGS-84 ellipsoid in the Earth-fixed frame.

    Args:
        latitude_rad: Geodetic latitudes, shape (S,), rad.
        longitude_rad: East longitudes, shape (S,), rad.
        altitude_m: Heights above the ellipsoid, shape (S,), m.

    Returns:
        Positions, shape (S, 3), m, and unit vectors to the geodetic zenith, shape (S, 3).

    Source: Vallado, Fundamentals of Astrodynamics and Applications, 4th ed., section 3.2.
    """
    sine, cosine = np.sin(latitude_rad), np.cos(latitude_rad)
    e2 = EARTH_FLATTENING * (2.0 - EARTH_FLATTENING)
    curvature = EARTH_RADIUS_M / np.sqrt(1.0 - e2 * sine * sine)
    east = np.cos(longitude_rad), np.sin(longitude_rad)
    up = np.stack((cosine * east[0], cosine * east[1], sine), axis=-1)
    radius = (curvature + altitude_m) * cosine
    z = (curvature * (1.0 - e2) + altitude_m) * sine
    return np.stack((radius * east[0], radius * east[1], z), axis=-1), up


def fixed_to_teme(vectors: NDArray[np.float64], gmst: float) -> NDArray[np.float64]:
    """
    Return Earth-fixed vectors, shape (..., 3), in TEME.

    Args:
        vectors: Positions or directions, any unit.
        gmst: Greenwich mean sidereal time, rad.

    Source: Vallado et al., Revisiting Spacetrack Report #3, AIAA 2006-6753, appendix C.
    """
    cosine, sine = math.cos(gmst), math.sin(gmst)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack((cosine * x - sine * y, sine * x + cosine * y, vectors[..., 2]), axis=-1)
