"""
Accelerometer: acceleration other than gravity.

It feels the thrust of a finite burn. Left out: drag (1e-7 m/s^2 and less at 780 km, below any
accelerometer's bias), and an impulsive delta-v, which has no duration.
"""

from __future__ import annotations

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene


class Accelerometer:
    """At the centre of mass, its axes along the body's; along the frame's without attitude."""

    name = "accelerometer"
    stream = "accelerometer"
    fields = (Field("ax_m_s2", "m/s^2"), Field("ay_m_s2", "m/s^2"), Field("az_m_s2", "m/s^2"))
    digits = 12
    channels = 3

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...]:
        """Return acceleration, m/s^2."""
        x, y, z = scene.to_body(scene.thrust_m_s2())
        a, b, c = error
        return x + a, y + b, z + c
