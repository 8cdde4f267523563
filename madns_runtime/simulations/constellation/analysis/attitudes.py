"""Comparison of two runs' rigid bodies: by what angle they are turned against each other, and how rates differ."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from madns_runtime.analysis.matching import Matched, match
from madns_runtime.analysis.sampling import as_rows
from madns_runtime.analysis.tables import ComparedRun
from madns_runtime.analysis.values import Floats
from madns_runtime.simulations.constellation.analysis.measurement_errors import (
    QUATERNION,
    rows_over_time,
)
from madns_runtime.simulations.constellation.analysis.slots import TIME_S

ATTITUDE = "attitude"
RATES = ("wx_body_rad_s", "wy_body_rad_s", "wz_body_rad_s")


@dataclass(slots=True, kw_only=True)
class AttitudeDifference:
    """Differences of one satellite's attitude and body rates between two runs."""

    agent: str
    count: int = 0
    angle_squares: float = 0.0
    """Of the angles that take the first run's body axes into the second's, rad^2."""
    angle_max_rad: float = 0.0
    angle_max_t_s: float | None = None
    angle_last_rad: float = 0.0
    rate_squares: float = 0.0
    """Of the differences of body rates, rad^2/s^2."""
    rate_max_rad_s: float = 0.0
    rate_last_rad_s: tuple[float, float] = (0.0, 0.0)
    """Magnitude of either run's body rates at the last instant that both have, rad/s."""

    @property
    def angle_deg_rms(self) -> float:
        """Root mean square of the angle, deg."""
        return math.degrees(math.sqrt(self.angle_squares / self.count)) if self.count else 0.0

    @property
    def rate_deg_s_rms(self) -> float:
        """Root mean square of the difference of body rates, deg/s."""
        return math.degrees(math.sqrt(self.rate_squares / self.count)) if self.count else 0.0

    def told(self) -> dict[str, Any]:
        """Return the figures by name, angles in degrees."""
        first, second = map(math.degrees, self.rate_last_rad_s)
        return {
            "count": self.count,
            "angle_deg_rms": self.angle_deg_rms,
            "angle_deg_max": math.degrees(self.angle_max_rad),
            "angle_max_t_s": self.angle_max_t_s,
            "angle_deg_last": math.degrees(self.angle_last_rad),
            "rate_deg_s_rms": self.rate_deg_s_rms,
            "rate_deg_s_max": math.degrees(self.rate_max_rad_s),
            "rate_deg_s_last_a": first,
            "rate_deg_s_last_b": second,
        }


def compare_attitudes(a: ComparedRun, b: ComparedRun) -> dict[str, AttitudeDifference]:
    """
    Return the differences by agent, of those whose attitude both runs recorded.

    Raises:
        MachineError: A file cannot be read.
    """
    found: dict[str, AttitudeDifference] = {}
    for key, recorded in a.streams.items():
        other = b.streams.get(key)
        if key[0] != ATTITUDE or other is None:
            continue
        columns = ("tick", *QUATERNION, *RATES)
        if not (set(columns) <= set(recorded.names()) and set(columns) <= set(other.names())):
            continue
        difference = AttitudeDifference(agent=recorded.source)
        sides = (
            rows_over_time(one, list(columns[1:]), "tick", 1.0 / (run.run.tick_hz or 1.0))
            for one, run in ((recorded, a), (other, b))
        )
        for piece in match(*sides, tolerance=TIME_S):
            _add(difference, piece)
        if difference.count:
            found[recorded.source] = difference
    return found


def total_attitude(found: Mapping[str, AttitudeDifference]) -> AttitudeDifference:
    """Return the difference over all satellites; of last ones the largest."""
    total = AttitudeDifference(agent="*")
    for one in found.values():
        total.count += one.count
        total.angle_squares += one.angle_squares
        total.rate_squares += one.rate_squares
        total.rate_max_rad_s = max(total.rate_max_rad_s, one.rate_max_rad_s)
        total.angle_last_rad = max(total.angle_last_rad, one.angle_last_rad)
        first, second = zip(total.rate_last_rad_s, one.rate_last_rad_s, strict=True)
        total.rate_last_rad_s = max(first), max(second)
        if total.angle_max_t_s is None or one.angle_max_rad > total.angle_max_rad:
            total.angle_max_rad, total.angle_max_t_s = one.angle_max_rad, one.angle_max_t_s
    return total


def _add(found: AttitudeDifference, piece: Matched) -> None:
    q_a, q_b = (as_rows(one.columns, QUATERNION) for one in (piece.a, piece.b))
    w_a, w_b = (as_rows(one.columns, RATES) for one in (piece.a, piece.b))
    is_there = np.isfinite(q_a + q_b).all(axis=1) & np.isfinite(w_a + w_b).all(axis=1)
    if not is_there.any():
        return
    q_a, q_b, w_a, w_b = q_a[is_there], q_b[is_there], w_a[is_there], w_b[is_there]
    angle = _angle_rad(q_a, q_b)
    rate = np.linalg.norm(w_b - w_a, axis=1)
    found.count += len(angle)
    found.angle_squares += float(np.dot(angle, angle))
    found.rate_squares += float(np.dot(rate, rate))
    found.rate_max_rad_s = max(found.rate_max_rad_s, float(rate.max()))
    worst = int(angle.argmax())
    if found.angle_max_t_s is None or angle[worst] > found.angle_max_rad:
        found.angle_max_rad = float(angle[worst])
        found.angle_max_t_s = float(piece.a.keys[is_there][worst])
    found.angle_last_rad = float(angle[-1])
    found.rate_last_rad_s = float(np.linalg.norm(w_a[-1])), float(np.linalg.norm(w_b[-1]))


def _angle_rad(q_a: Floats, q_b: Floats) -> Floats:
    """
    Return the angles between pairs of attitudes, 0 to pi, rad.

    Args:
        q_a: Unit quaternions, scalar last, shape (N, 4).
        q_b: The same; of the two of one attitude any.

    By the arctangent of vector and scalar part of the difference, which is exact for small angles, too.
    """
    scalar = np.einsum("ni,ni->n", q_a, q_b)
    vector = q_a[:, 3:] * q_b[:, :3] - q_b[:, 3:] * q_a[:, :3] - np.cross(q_a[:, :3], q_b[:, :3])
    angles: Floats = 2.0 * np.arctan2(np.linalg.norm(vector, axis=1), np.abs(scalar))
    return angles
