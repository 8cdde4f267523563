"""
Accelerometer: specific force, that is acceleration other than gravity: thrust, impulses and drag.

It integrates, as real ones do: what it says is the mean since the measurement before. So a burn between two
measurements is not lost, and their products with the time between them add up to the change of velocity. An
impulse, which has no duration, is spread over the measurement that it falls in.
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

    def __init__(self) -> None:
        self._sum_m_s = [0.0, 0.0, 0.0]
        self._since_s: float | None = None
        self._t_s = 0.0
        self._given_m_s = self._drag_m_s2 = (0.0, 0.0, 0.0)

    def feel(self, scene: Scene) -> None:
        """Take what acted since the tick before, turned as the body is now; called every tick."""
        given, step_s = scene.given_m_s(), scene.t_s - self._t_s
        if self._since_s is None:
            self._since_s = scene.t_s
        else:
            change = zip(given, self._given_m_s, self._drag_m_s2, strict=True)
            x, y, z = (now - before + drag * step_s for now, before, drag in change)
            for axis, gained in enumerate(scene.to_body((x, y, z))):
                self._sum_m_s[axis] += gained
        self._t_s, self._given_m_s, self._drag_m_s2 = scene.t_s, given, scene.drag_m_s2()

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...] | None:
        """Return the mean specific force since the measurement before, m/s^2; None for the first, which has none."""
        if self._since_s is None or scene.t_s <= self._since_s:
            return None
        share = 1.0 / (scene.t_s - self._since_s)
        x, y, z = (gained * share for gained in self._sum_m_s)
        self._sum_m_s, self._since_s = [0.0, 0.0, 0.0], scene.t_s
        a, b, c = error
        return x + a, y + b, z + c
