"""One vehicle's known orbit as a curve, and the Earth's magnetic field along it. Without scipy: for the host's loop."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from datetime import datetime
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.equipment import FieldName
from madns_runtime.simulations.constellation.geomagnetic_field import field_model
from madns_runtime.simulations.constellation.orbit.constants import SECONDS_PER_DAY
from madns_runtime.simulations.constellation.orbit.earth import days_since_j2000, gmst_rad
from madns_runtime.simulations.constellation.orbit.interpolation import (
    Coefficients,
    coefficients,
    evaluate,
)
from madns_runtime.simulations.constellation.orbit.magnetic import decimal_year, inertial_field_t
from madns_runtime.simulations.constellation.thrust import Vector

Array = NDArray[np.float64]

FIELD_SPAN_S = 2.0
"""Most between the ends of a cubic through four values of the field: in LEO it errs a 1e-12 of the field."""
FIELDS_KEPT = 8
"""Fields of so many models and epochs are kept: an IGRF is read from a file."""


class OrbitCurve:
    """
    One vehicle's orbit as cubics between its knots.

    Args:
        times_s: Shape (K,), s, ascending, K >= 2.
        states: Shape (K, 6), m and m/s.
    """

    def __init__(self, times_s: Array, states: Array) -> None:
        self._times_s: list[float] = times_s.tolist()
        self._rows: list[list[float]] = states.tolist()
        self._cubics: dict[int, Coefficients] = {}

    def state(self, t_s: float) -> tuple[float, ...]:
        """Return position (m) and velocity (m/s): six numbers; at a knot those of the knot, to the last digit."""
        place = self._place(t_s)
        start_s, end_s = self._times_s[place : place + 2]
        if t_s in (start_s, end_s):
            return tuple(self._rows[place + (t_s == end_s)])
        knot_s = end_s - start_s
        return evaluate(self._cubic(place), (t_s - start_s) / knot_s, knot_s)

    def position(self, t_s: float) -> Vector:
        """Return the position, m."""
        place = self._place(t_s)
        ax, bx, cx, dx, ay, by, cy, dy, az, bz, cz, dz = self._cubic(place)
        start_s, end_s = self._times_s[place : place + 2]
        s = (t_s - start_s) / (end_s - start_s)
        return (
            ax + s * (bx + s * (cx + s * dx)),
            ay + s * (by + s * (cy + s * dy)),
            az + s * (bz + s * (cz + s * dz)),
        )

    def _place(self, t_s: float) -> int:
        return min(max(bisect_right(self._times_s, t_s) - 1, 0), len(self._times_s) - 2)

    def _cubic(self, place: int) -> Coefficients:
        cubics = self._cubics.get(place)
        if cubics is None:
            knot_s = self._times_s[place + 1] - self._times_s[place]
            cubics = coefficients(self._rows[place], self._rows[place + 1], knot_s)
            self._cubics[place] = cubics
        return cubics


class FieldCurve:
    """
    The Earth's field along an orbit between two times, inertial, T: cubics, each through four of its values.

    Args:
        orbit: Where the vehicle is.
        field_t: Field at an inertial position, m, and a simulated time, s.
        from_s: Beginning.
        until_s: End, after the beginning.
    """

    def __init__(
        self,
        orbit: OrbitCurve,
        field_t: Callable[[Vector, float], Vector],
        from_s: float,
        until_s: float,
    ) -> None:
        self._from_s = from_s
        count = max(1, math.ceil((until_s - from_s) / FIELD_SPAN_S))
        self._span_s = (until_s - from_s) / count
        step_s = self._span_s / 3.0
        values = [
            field_t(orbit.position(at_s), at_s)
            for at_s in (from_s + number * step_s for number in range(3 * count + 1))
        ]
        self._spans = [_newton(values[3 * n : 3 * n + 4], step_s) for n in range(count)]
        self._step_s = step_s

    def at(self, t_s: float) -> Vector:
        """Return the field."""
        since_s = t_s - self._from_s
        place = min(max(int(since_s / self._span_s), 0), len(self._spans) - 1)
        ax, bx, cx, dx, ay, by, cy, dy, az, bz, cz, dz = self._spans[place]
        h = self._step_s
        s0 = since_s - place * self._span_s
        s1, s2 = s0 - h, s0 - 2.0 * h
        return (
            ax + s0 * (bx + s1 * (cx + s2 * dx)),
            ay + s0 * (by + s1 * (cy + s2 * dy)),
            az + s0 * (bz + s1 * (cz + s2 * dz)),
        )


def _newton(values: Sequence[Vector], step_s: float) -> tuple[float, ...]:
    """Return the divided differences of four vectors *step_s* apart, four for each component."""
    numbers: list[float] = []
    for a, b, c, d in zip(*values, strict=True):
        second = c - 2.0 * b + a
        third = d - 3.0 * c + 3.0 * b - a
        numbers += (a, (b - a) / step_s, second / (2.0 * step_s**2), third / (6.0 * step_s**3))
    return tuple(numbers)


@lru_cache(maxsize=FIELDS_KEPT)
def earth_field(name: FieldName, epoch_utc: datetime) -> Callable[[Vector, float], Vector]:
    """
    Return the field at an inertial position, m, and a simulated time, s: inertial, T.

    Raises:
        MissingExtraError: The IGRF is wanted and not installed.
    """
    epoch_days = days_since_j2000(epoch_utc)
    fixed_field_t = field_model(name, decimal_year(epoch_days))

    def field_t(r_m: Vector, t_s: float) -> Vector:
        return inertial_field_t(fixed_field_t, r_m, gmst_rad(epoch_days + t_s / SECONDS_PER_DAY))

    return field_t
