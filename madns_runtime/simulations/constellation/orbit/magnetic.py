"""
The Earth's magnetic field: a tilted dipole, or spherical harmonics to any degree. Pure.

Positions and fields are Earth-fixed, geocentric, m and T.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

Vector = tuple[float, float, float]
Coefficients = Mapping[tuple[int, int], float]
"""Schmidt semi-normalised Gauss coefficients, T, by degree and order: order m > 0 is g, -m is h."""

REFERENCE_RADIUS_M = 6_371_200.0
"""Of the expansion. Source: IGRF."""

IGRF_14_DIPOLE_NT = {
    1980.0: (-29992.0, -1956.0, 5604.0),
    1985.0: (-29873.0, -1905.0, 5500.0),
    1990.0: (-29775.0, -1848.0, 5406.0),
    1995.0: (-29692.0, -1784.0, 5306.0),
    2000.0: (-29619.4, -1728.2, 5186.1),
    2005.0: (-29554.63, -1669.05, 5077.99),
    2010.0: (-29496.57, -1586.42, 4944.26),
    2015.0: (-29441.46, -1501.77, 4795.99),
    2020.0: (-29403.41, -1451.37, 4653.35),
    2025.0: (-29350.0, -1410.3, 4545.5),
    2030.0: (-29287.0, -1360.3, 4438.0),
}
"""g10, g11 and h11 by year, nT. Source: IGRF-14, doi:10.5281/zenodo.14012302; 2030 from its secular
variation."""
NT = 1e-9
POLE_M = 1e-3
"""Nearer to the axis there is no longitude, m."""


def decimal_year(days: float) -> float:
    """Return the year with its fraction, from days since 2000-01-01 12:00."""
    return 2000.0 + (days + 0.5) / 365.25


def dipole_at(year: float) -> Coefficients:
    """Return the coefficients of degree 1 at a decimal year; the nearest ones outside of 1980 to 2030."""
    years = sorted(IGRF_14_DIPOLE_NT)
    year = min(max(year, years[0]), years[-1])
    at = next(number for number, until in enumerate(years[1:]) if year <= until)
    first, second = years[at], years[at + 1]
    part = (year - first) / (second - first)
    g10, g11, h11 = (
        NT * (a + part * (b - a))
        for a, b in zip(IGRF_14_DIPOLE_NT[first], IGRF_14_DIPOLE_NT[second], strict=True)
    )
    return {(1, 0): g10, (1, 1): g11, (1, -1): h11}


def dipole_field_t(coefficients: Coefficients, r_m: Vector) -> Vector:
    """
    Return the field of the coefficients of degree 1 alone, T.

    Source: B = (a/r)^3 (3 (m.u) u - m) with m = (g11, h11, g10) and u = r/|r|.
    """
    mx, my, mz = coefficients[1, 1], coefficients[1, -1], coefficients[1, 0]
    x, y, z = r_m
    r = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / r, y / r, z / r
    scale = (REFERENCE_RADIUS_M / r) ** 3
    along = 3.0 * (mx * x + my * y + mz * z)
    return scale * (along * x - mx), scale * (along * y - my), scale * (along * z - mz)


def inertial_field_t(field_t: Callable[[Vector], Vector], r_m: Vector, gmst_rad: float) -> Vector:
    """
    Return the field in inertial axes, T.

    Args:
        field_t: Earth-fixed field at an Earth-fixed position.
        r_m: Inertial position, m.
        gmst_rad: Greenwich mean sidereal time, rad.
    """
    x, y, z = r_m
    cosine, sine = math.cos(gmst_rad), math.sin(gmst_rad)
    fx, fy, fz = field_t((cosine * x + sine * y, cosine * y - sine * x, z))
    return cosine * fx - sine * fy, sine * fx + cosine * fy, fz


class Harmonics:
    """
    A field of spherical harmonics.

    Args:
        coefficients: From degree 1 on, complete.

    Source: Wertz, Spacecraft Attitude Determination and Control, appendix H: Gauss-normalised
    functions by recursion, the normalisation put into the coefficients once.
    """

    def __init__(self, coefficients: Coefficients) -> None:
        self.degree = max(n for n, _ in coefficients)
        self._terms: list[list[tuple[float, float, float]]] = [[(0.0, 0.0, 0.0)]]
        """By degree and order: g and h with the normalisation in them, and the recursion's factor."""
        first = 1.0
        for n in range(1, self.degree + 1):
            first *= (2.0 * n - 1.0) / n
            scale, row = first, []
            for m in range(n + 1):
                if m:
                    scale *= math.sqrt((n - m + 1) * (2.0 if m == 1 else 1.0) / (n + m))
                g = scale * coefficients[n, m]
                h = scale * coefficients[n, -m] if m else 0.0
                factor = ((n - 1) ** 2 - m * m) / ((2 * n - 1) * (2 * n - 3)) if n > 1 else 0.0
                row.append((g, h, factor))
            self._terms.append(row)

    def field_t(self, r_m: Vector) -> Vector:
        """Return the field, T."""
        x, y, z = r_m
        if math.hypot(x, y) < POLE_M:
            x, y = POLE_M, 0.0  # at a pole every longitude will do
        flat = math.hypot(x, y)
        r = math.hypot(flat, z)
        sine, cosine = flat / r, z / r
        cos_1, sin_1 = x / flat, y / flat
        up, south, east = self._spherical(r, sine, cosine, cos_1, sin_1)
        outward = up * sine + south * cosine
        return (
            outward * cos_1 - east * sin_1,
            outward * sin_1 + east * cos_1,
            up * cosine - south * sine,
        )

    def _spherical(
        self, r: float, sine: float, cosine: float, cos_1: float, sin_1: float
    ) -> Vector:
        """Return the field upward, southward and eastward from colatitude and longitude."""
        up = south = east = 0.0
        size = self.degree + 1
        before, last = [0.0] * size, [1.0] + [0.0] * self.degree
        slope_before, slope_last = [0.0] * size, [0.0] * size
        power = (REFERENCE_RADIUS_M / r) ** 2
        cos_m, sin_m = [1.0], [0.0]
        for n in range(1, size):
            power *= REFERENCE_RADIUS_M / r
            cos_m.append(cos_m[-1] * cos_1 - sin_m[-1] * sin_1)
            sin_m.append(sin_m[-1] * cos_1 + cos_m[-2] * sin_1)
            p, slope = [0.0] * size, [0.0] * size
            for m, (g, h, factor) in enumerate(self._terms[n]):
                if m == n:
                    p[m] = sine * last[m - 1]
                    slope[m] = sine * slope_last[m - 1] + cosine * last[m - 1]
                else:
                    p[m] = cosine * last[m] - factor * before[m]
                    slope[m] = cosine * slope_last[m] - sine * last[m] - factor * slope_before[m]
                value = g * cos_m[m] + h * sin_m[m]
                up += power * (n + 1) * value * p[m]
                south -= power * value * slope[m]
                east += power * m * (g * sin_m[m] - h * cos_m[m]) * p[m]
            before, last, slope_before, slope_last = last, p, slope_last, slope
        return up, south, east / sine
