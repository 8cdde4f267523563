"""Direction of the Sun, and whether the Earth hides it. Pure."""

from __future__ import annotations

import math

from madns_runtime.simulations.constellation.orbit.constants import EARTH_RADIUS_M

Vector = tuple[float, float, float]

ASTRONOMICAL_UNIT_M = 149_597_870_700.0
"""Source: IAU 2012 resolution B2."""
SUN_RADIUS_M = 695_700e3
"""Source: IAU 2015 resolution B3, nominal."""


def sun_m(days: float) -> Vector:
    """
    Return the Sun's position from the Earth's centre, m, true to 0.01 deg from 1950 to 2050.

    Args:
        days: Since 2000-01-01 12:00, days; UTC will do.

    The frame is the mean equator and equinox of date. TEME's equator is the true one, 10 arc seconds
    away at most, which is less than the formula's own error.
    Source: The Astronomical Almanac, section C, low-precision formulas for the Sun.
    """
    mean_longitude = 280.460 + 0.9856474 * days
    anomaly_rad = math.radians(math.fmod(357.528 + 0.9856003 * days, 360.0))
    longitude_deg = (
        mean_longitude + 1.915 * math.sin(anomaly_rad) + 0.020 * math.sin(2 * anomaly_rad)
    )
    longitude_rad = math.radians(math.fmod(longitude_deg, 360.0))
    obliquity_rad = math.radians(23.439 - 4.0e-7 * days)
    distance = 1.00014 - 0.01671 * math.cos(anomaly_rad) - 0.00014 * math.cos(2 * anomaly_rad)
    distance_m = distance * ASTRONOMICAL_UNIT_M
    sine = math.sin(longitude_rad)
    return (
        distance_m * math.cos(longitude_rad),
        distance_m * math.cos(obliquity_rad) * sine,
        distance_m * math.sin(obliquity_rad) * sine,
    )


def is_in_umbra(r_m: Vector, sun_r_m: Vector) -> bool:
    """
    Tell whether the Earth hides the whole Sun: a conical shadow of a sphere without atmosphere.

    The penumbra counts as lit. At 780 km it lasts 9 s where the Sun stands in the orbit's plane, 15 s where it stands
    45 deg off it, 38 s at 60 deg, and minutes where the orbit only grazes the shadow; 8 s at least in LEO.

    Args:
        r_m: Position from the Earth's centre, m.
        sun_r_m: The Sun's position in the same frame, m.

    Source: Montenbruck and Gill, Satellite Orbits, section 3.4.2: the discs as seen from the vehicle.
    """
    x, y, z = r_m
    dx, dy, dz = sun_r_m[0] - x, sun_r_m[1] - y, sun_r_m[2] - z
    r, distance = math.hypot(x, y, z), math.hypot(dx, dy, dz)
    cosine = -(x * dx + y * dy + z * dz) / (r * distance)
    separation_rad = math.acos(min(1.0, max(-1.0, cosine)))
    sun_rad = math.asin(SUN_RADIUS_M / distance)
    earth_rad = math.asin(min(1.0, EARTH_RADIUS_M / r))
    return separation_rad < earth_rad - sun_rad
