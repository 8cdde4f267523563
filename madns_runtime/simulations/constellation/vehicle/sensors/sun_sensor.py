"""Sun sensor: the direction of the Sun, unless the Earth hides it."""

from __future__ import annotations

import math

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene


class SunSensor:
    """Sees all around; its axes are the body's, or the frame's without attitude."""

    name = "sun_sensor"
    stream = "sun_sensor"
    fields = (Field("sx", "1"), Field("sy", "1"), Field("sz", "1"))
    digits = 9
    channels = 3

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...] | None:
        """Return the unit vector to the Sun, turned by the errors, rad; None in the Earth's umbra."""
        direction = scene.sun_direction()
        if direction is None:
            return None
        x, y, z = scene.to_body(direction)
        a, b, c = error
        x, y, z = x + b * z - c * y, y + c * x - a * z, z + a * y - b * x
        length = math.sqrt(x * x + y * y + z * z)
        return x / length, y / length, z / length
