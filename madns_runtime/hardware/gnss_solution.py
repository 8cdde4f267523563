"""
One solution of a GNSS receiver: where, how fast and when, in the forms that its messages want. Pure.

Times are UTC as seconds since 1970 without leap seconds (Unix time); GPS time is ahead of UTC by the leap seconds since 1980.
A leap second itself has no Unix time: over one, GPS time goes on by a second more than UTC.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

WGS_84_RADIUS_M: Final = 6_378_137.0
WGS_84_FLATTENING: Final = 1.0 / 298.257_223_563
E2: Final = WGS_84_FLATTENING * (2.0 - WGS_84_FLATTENING)
GPS_EPOCH_UNIX_S: Final = 315_964_800
"""1980-01-06 00:00:00 UTC, when GPS time began."""
LEAP_SECONDS_UTC: Final = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01"),
    *("1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01"),
    *("1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
"""Days before which a leap second was put in since GPS time began. Source: IERS, Bulletins C up to 52; none since has one."""
LEAP_SECONDS_UNIX_MS: Final = tuple(
    1000 * round(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp())
    for day in LEAP_SECONDS_UTC
)
WEEK_MS: Final = 604_800_000
ITERATIONS_MAX: Final = 12
TIME_ERROR_S: Final = 1e-6
"""Of a date as a float of days or seconds."""
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssSolution:
    """One epoch, on a whole millisecond as a receiver's are."""

    utc_ms: int
    """Unix time, ms."""
    leap_s: int
    """GPS time minus UTC, s."""
    position_m: Vector
    """WGS-84, Earth-fixed."""
    velocity_m_s: Vector
    """Earth-fixed."""

    @classmethod
    def of(cls, values: Sequence[float], leap_s: int | None = None) -> GnssSolution:
        """
        Return the solution of a point: UTC (Unix time, s), position, m, velocity, m/s.

        Without *leap_s*, GPS time is ahead of UTC by what it was then: 0 s before July 1981, 18 s from 2017 on.
        It is brought to the nearest whole millisecond by its velocity: in half of one, gravity moves it by 1 um. Times
        that differ from one by less than a float of today's date can tell are on it.
        """
        utc_s, x, y, z, vx, vy, vz = values
        utc_ms = round(utc_s * 1e3)
        step_s = utc_ms * 1e-3 - utc_s
        if abs(step_s) < TIME_ERROR_S:
            step_s = 0.0
        if leap_s is None:
            leap_s = bisect_right(LEAP_SECONDS_UNIX_MS, utc_ms)
        position_m = (x + vx * step_s, y + vy * step_s, z + vz * step_s)
        return cls(utc_ms=utc_ms, leap_s=leap_s, position_m=position_m, velocity_m_s=(vx, vy, vz))

    @property
    def time_of_week_ms(self) -> int:
        """Time since the beginning of the GPS week, ms."""
        return self._gps_ms % WEEK_MS

    @property
    def week(self) -> int:
        """Number of the GPS week, counted on beyond 1023."""
        return self._gps_ms // WEEK_MS

    @property
    def _gps_ms(self) -> int:
        return self.utc_ms + (self.leap_s - GPS_EPOCH_UNIX_S) * 1000

    @property
    def utc(self) -> datetime:
        """Calendar date and time of day, whole seconds."""
        return datetime.fromtimestamp(self.utc_ms // 1000, UTC)

    @property
    def millisecond(self) -> int:
        """Of the second."""
        return self.utc_ms % 1000

    def geodetic(self) -> Vector:
        """Return latitude and longitude, rad, and height above the ellipsoid, m."""
        return geodetic(self.position_m)

    def velocity_ned_m_s(self, latitude_rad: float, longitude_rad: float) -> Vector:
        """Return the velocity to the north, to the east and down, m/s."""
        vx, vy, vz = self.velocity_m_s
        sine, cosine = math.sin(latitude_rad), math.cos(latitude_rad)
        east_sine, east_cosine = math.sin(longitude_rad), math.cos(longitude_rad)
        outward = east_cosine * vx + east_sine * vy
        return (
            cosine * vz - sine * outward,
            east_cosine * vy - east_sine * vx,
            -(cosine * outward + sine * vz),
        )


def geodetic(position_m: Vector) -> Vector:
    """
    Return latitude and longitude, rad, and height above the WGS-84 ellipsoid, m, of an Earth-fixed position.

    Source: Vallado, Fundamentals of Astrodynamics and Applications, 4th ed., algorithm 12, with a height that needs no
    other form at the poles. The iteration gains two digits and more in each step anywhere above the ground.
    """
    x, y, z = position_m
    flat_m = math.hypot(x, y)
    latitude = math.atan2(z, flat_m * (1.0 - E2))
    for _ in range(ITERATIONS_MAX):
        sine = math.sin(latitude)
        curvature_m = WGS_84_RADIUS_M / math.sqrt(1.0 - E2 * sine * sine)
        before, latitude = latitude, math.atan2(z + E2 * curvature_m * sine, flat_m)
        if abs(latitude - before) < 1e-15:
            break
    sine, cosine = math.sin(latitude), math.cos(latitude)
    height_m = flat_m * cosine + z * sine - WGS_84_RADIUS_M * math.sqrt(1.0 - E2 * sine * sine)
    return latitude, math.atan2(y, x), height_m
