"""What there is to measure: a vehicle's truth in one tick, and what surrounds it there."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

from madns_runtime.simulations.constellation.orbit.earth import days_since_j2000, gmst_rad
from madns_runtime.simulations.constellation.orbit.quaternions import rotate
from madns_runtime.simulations.constellation.orbit.sun import is_in_umbra, sun_m

Vector = tuple[float, float, float]
SECONDS_PER_DAY = 86_400.0


class Scene:
    """
    One vehicle's surroundings; `move` it to each tick.

    Args:
        epoch_utc: UTC of simulated time zero, ISO 8601.
        thrust_at: Returns the acceleration other than gravity and drag at a time, m/s^2, inertial; None
            where the vehicle coasts.
    """

    def __init__(self, epoch_utc: str, thrust_at: Callable[[float], Vector | None]) -> None:
        self._epoch_days = days_since_j2000(datetime.fromisoformat(epoch_utc))
        self._thrust_at = thrust_at
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

    def thrust_m_s2(self) -> Vector:
        """Return the acceleration of thrust, inertial, m/s^2."""
        return self._thrust_at(self.t_s) or (0.0, 0.0, 0.0)

    def sun_direction(self) -> Vector | None:
        """Return the unit vector to the Sun, inertial; None where the Earth hides it."""
        r_m = (self.state[0], self.state[1], self.state[2])
        sun = sun_m(self.days)
        if is_in_umbra(r_m, sun):
            return None
        x, y, z = (far - near for far, near in zip(sun, r_m, strict=True))
        distance = (x * x + y * y + z * z) ** 0.5
        return x / distance, y / distance, z / distance
