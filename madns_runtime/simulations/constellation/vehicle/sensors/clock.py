"""Clock: the time that the vehicle believes it is."""

from __future__ import annotations

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene


class Clock:
    """Its bias is an offset; the walk of it is the random walk of an oscillator's phase."""

    name = "clock"
    stream = "clock_sensor"  # the stream clock is the framework's own
    fields = (Field("clock_s", "s"),)
    digits = 12
    channels = 1

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...]:
        """Return time since the epoch, s."""
        return (scene.t_s + error[0],)
