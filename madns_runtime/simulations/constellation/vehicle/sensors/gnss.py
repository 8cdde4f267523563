"""GNSS receiver: position and velocity in the run's frame."""

from __future__ import annotations

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.equipment import Gnss
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene


class GnssReceiver:
    """Sees at any height; its antenna is at the centre of mass."""

    name = "gnss"
    stream = "gnss"
    fields = (
        Field("x_teme_m", "m"),
        Field("y_teme_m", "m"),
        Field("z_teme_m", "m"),
        Field("vx_teme_m_s", "m/s"),
        Field("vy_teme_m_s", "m/s"),
        Field("vz_teme_m_s", "m/s"),
    )
    digits = 6
    channels = 6
    bias = (True, True, True, False, False, False)

    @staticmethod
    def white(settings: Gnss) -> tuple[float, ...]:
        """Return the standard deviation of each channel's white noise."""
        return (settings.noise,) * 3 + (settings.velocity_noise_m_s,) * 3

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...]:
        """Return position, m, and velocity, m/s."""
        x, y, z, vx, vy, vz = scene.state[:6]
        a, b, c, d, e, f = error
        return x + a, y + b, z + c, vx + d, vy + e, vz + f
