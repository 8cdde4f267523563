"""
From tumbling to rest by magnetic coils (B-dot), then reaction wheels hold: as firmware/detumble does it in C.

flight.settings: dipole_a_m2_max, damping_n_m_s, hold_below_rad_s, hold_damping_n_m_s, hold_stiffness_n_m,
torque_n_m_max, span_s, settled_s, command_s, lead_s; see firmware/detumble/control.h.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Any

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Readings,
)

Vector = tuple[float, ...]

DEFAULTS = {
    "dipole_a_m2_max": 0.2,
    "damping_n_m_s": 3e-4,
    "hold_below_rad_s": 0.0105,
    "hold_damping_n_m_s": 1e-3,
    "hold_stiffness_n_m": 1e-4,
    "torque_n_m_max": 1e-4,
    "span_s": 1.0,
    "settled_s": 3.0,
    "command_s": 0.5,
    "lead_s": 0.5,
}
EPSILON_S = 1e-6


class Detumble(FlightSoftware):
    """Brakes the turning across the field by coils, then all turning by wheels."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings."""
        self.context = context
        self.set: dict[str, Any] = DEFAULTS | dict(context.settings)
        self.fields: deque[tuple[float, Vector]] = deque(maxlen=128)
        self.change_t_s: Vector = (0.0, 0.0, 0.0)
        self.across_rad_s: float | None = None
        self.low_since_s: float | None = None
        self.is_held = False
        self.rate: Vector | None = None
        self.rated_s = 0.0
        self.angle: Vector = (0.0, 0.0, 0.0)
        self.next_s: float | None = None

    def step(self, t_s: float, readings: Readings) -> None:
        """Take what the sensors say, and command as often as is due."""
        if (gyro := readings.get("gyro")) is not None:
            self.take_rate(gyro.t_s, gyro.values)
        if (magnetometer := readings.get("magnetometer")) is not None:
            self.take_field(t_s, magnetometer.values)
        self.next_s = t_s if self.next_s is None else self.next_s
        if t_s >= self.next_s - EPSILON_S:
            self.command(t_s)
            self.next_s = max(self.next_s, t_s - self.set["command_s"]) + self.set["command_s"]
        if self.across_rad_s is not None:
            self.context.estimate(
                {"rate_across_rad_s": self.across_rad_s, "is_held": float(self.is_held)}
            )

    def take_rate(self, t_s: float, rate: Vector) -> None:
        """Take the gyro's rates; the angle counts from when the wheels took over."""
        if self.is_held:
            passed_s = t_s - self.rated_s
            self.angle = tuple(a + w * passed_s for a, w in zip(self.angle, rate, strict=True))
        self.rate, self.rated_s = rate, t_s

    def take_field(self, t_s: float, field_t: Vector) -> None:
        """Take the magnetometer's field, and what it has changed over the last span."""
        self.fields.append((t_s, field_t))
        while t_s - self.fields[0][0] > self.set["span_s"] + EPSILON_S:
            self.fields.popleft()
        before_s, before_t = self.fields[0]
        if t_s <= before_s:
            return
        passed_s = t_s - before_s
        self.change_t_s = tuple((b - a) / passed_s for a, b in zip(before_t, field_t, strict=True))
        self.across_rad_s = math.hypot(*self.change_t_s) / math.hypot(*field_t)
        if self.across_rad_s >= self.set["hold_below_rad_s"]:
            self.low_since_s = None
        elif self.low_since_s is None:
            self.low_since_s = t_s
        elif t_s - self.low_since_s >= self.set["settled_s"] and self.rate is not None:
            self.is_held = True

    def command(self, t_s: float) -> None:
        """Command coils or wheels."""
        begin_s, duration_s = t_s + self.set["lead_s"], self.set["command_s"]
        if self.is_held and self.rate is not None:
            pairs = zip(self.rate, self.angle, strict=True)
            wanted = [
                -self.set["hold_damping_n_m_s"] * w - self.set["hold_stiffness_n_m"] * angle
                for w, angle in pairs
            ]
            torque = limited(wanted, self.set["torque_n_m_max"])
            self.context.torque(torque, at_s=begin_s, duration_s=duration_s)
        elif self.across_rad_s is not None:
            strength2 = sum(b * b for b in self.fields[-1][1])
            wanted = [-self.set["damping_n_m_s"] / strength2 * change for change in self.change_t_s]
            dipole = limited(wanted, self.set["dipole_a_m2_max"])
            self.context.dipole(dipole, at_s=begin_s, duration_s=duration_s)


def limited(values: Iterable[float], most: float) -> Vector:
    """Return values within plus and minus *most*."""
    return tuple(min(max(value, -most), most) for value in values)
