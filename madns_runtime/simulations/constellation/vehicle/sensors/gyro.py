"""Gyro: body rates of a rigid body."""

from __future__ import annotations

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene


class Gyro:
    """Three axes along the body's."""

    name = "gyro"
    stream = "gyro"
    fields = (
        Field("wx_body_rad_s", "rad/s"),
        Field("wy_body_rad_s", "rad/s"),
        Field("wz_body_rad_s", "rad/s"),
    )
    digits = 12
    channels = 3

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...]:
        """Return body rates, rad/s."""
        wx, wy, wz = scene.state[10:13]
        a, b, c = error
        return wx + a, wy + b, wz + c
