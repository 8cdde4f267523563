"""Star tracker: the attitude of a rigid body."""

from __future__ import annotations

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.orbit.quaternions import from_rotation, multiply
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene


class StarTracker:
    """Sees stars wherever it looks: neither Sun nor Earth blind it."""

    name = "star_tracker"
    stream = "star_tracker"
    fields = (Field("q1", "1"), Field("q2", "1"), Field("q3", "1"), Field("q4", "1"))
    digits = 12
    channels = 3

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...]:
        """Return the quaternion, turned on by the errors about the body axes, rad."""
        return multiply(scene.state[6:10], from_rotation(error))
