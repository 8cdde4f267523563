"""Surroundings of a sensor: a vehicle's truth in one tick, and the fields around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime

import numpy as np

from madns_runtime.simulations.constellation.orbit.atmosphere import drag_m_s2
from madns_runtime.simulations.constellation.orbit.constants import SECONDS_PER_DAY
from madns_runtime.simulations.constellation.orbit.earth import (
    days_since_j2000,
    gmst_rad,
    gmst_rate_rad_s,
)
from madns_runtime.simulations.constellation.orbit.quaternions import Vector, rotate
from madns_runtime.simulations.constellation.orbit.sun import is_in_umbra, sun_m
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer

State = tuple[float, ...]


class Scene:
    """
    One vehicle's surroundings; `move` it to each tick.

    Args:
        epoch_utc: UTC of simulated time zero, ISO 8601.
        pushes: What thrust, impulses and drag there are: the vehicle's truth buffer.
        radius_m: The Earth's, of the gravity model: where truth's atmosphere begins.
    """

    def __init__(self, epoch_utc: str, pushes: TruthBuffer, radius_m: float) -> None:
        self._epoch_days = days_since_j2000(datetime.fromisoformat(epoch_utc))
        self._pushes = pushes
        self._radius_m = radius_m
        self.t_s = 0.0
        self.state: tuple[float, ...] = ()
        """Truth: position, m, velocity, m/s; of a rigid body also quaternion and body rates, rad/s."""

    def move(self, t_s: float, state: tuple[float, ...]) -> None:
        """Set time and truth."""
        self.t_s, self.state = t_s, state

    @property
    def days(self) -> float:
        """Days since 2000-01-01 12:00."""
        return self._epoch_days + self.t_s / SECONDS_PER_DAY

    @property
    def gmst_rad(self) -> float:
        """Greenwich mean sidereal time, rad."""
        return gmst_rad(self.days)

    def to_body(self, vector: Vector) -> Vector:
        """Return an inertial vector in body axes; unchanged for a vehicle without attitude."""
        state = self.state
        return rotate(state[6:10], vector) if len(state) > 6 else vector

    def from_fixed(self, t_s: float, r_m: Sequence[float], v_m_s: Sequence[float]) -> State:
        """Return position and velocity in the run's frame, six numbers, from those in the turning Earth's at a time."""
        days = self._epoch_days + t_s / SECONDS_PER_DAY
        angle, rate = gmst_rad(days), gmst_rate_rad_s(days)
        cosine, sine = math.cos(angle), math.sin(angle)
        (x, y, z), (vx, vy, vz) = r_m, v_m_s
        vx, vy = vx - rate * y, vy + rate * x
        return (
            cosine * x - sine * y,
            sine * x + cosine * y,
            z,
            cosine * vx - sine * vy,
            sine * vx + cosine * vy,
            vz,
        )

    def given_m_s(self) -> tuple[Vector, Vector]:
        """Return the changes of velocity by thrust, and by impulses, since the first call, inertial, m/s."""
        return self._pushes.given_m_s(self.t_s)

    def drag_m_s2(self) -> Vector:
        """Return the acceleration by drag, inertial, m/s^2; zero where truth has none."""
        ballistic_m2_kg = self._pushes.ballistic_m2_kg
        if ballistic_m2_kg is None:
            return 0.0, 0.0, 0.0
        state = np.array(self.state[:6]).reshape(6, 1)
        r, v = state[:3], state[3:]
        r2 = np.einsum("in,in->n", r, r)
        drag = drag_m_s2(r, r2, v, ballistic_m2_kg=ballistic_m2_kg, radius_m=self._radius_m)
        x, y, z = drag[:, 0].tolist()
        return x, y, z

    def sun_direction(self) -> Vector | None:
        """Return the unit vector to the Sun, inertial; None where the Earth hides it."""
        r_m = (self.state[0], self.state[1], self.state[2])
        sun = sun_m(self.days)
        if is_in_umbra(r_m, sun):
            return None
        x, y, z = (far - near for far, near in zip(sun, r_m, strict=True))
        distance = (x * x + y * y + z * z) ** 0.5
        return x / distance, y / distance, z / distance
