"""
Channels of devices that a vehicle's sensors are read from. Pure.

Standard library alone, and on neither side of the wall: `cosmos validate` asks here as well as the vehicle.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

from madns_runtime.simulations.constellation.equipment import (
    AnySensorDevice,
    GnssDevice,
    SensorNoise,
    Vehicle,
)

VALUES = {
    "gnss": ("m", 3),
    "gyro": ("rad/s", 3),
    "accelerometer": ("m/s^2", 3),
    "magnetometer": ("T", 3),
    "star_tracker": ("1", 4),
    "sun_sensor": ("1", 3),
    "clock": ("s", 1),
}
"""Unit and number of the values of each sensor's channel, of a receiver that of positions."""
VELOCITIES = ("m/s", 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorChannel:
    """A channel that a sensor is read from."""

    key: str
    """Field of the sensor's settings that names it."""
    device: str
    name: str
    unit: str
    """That its own must convert to."""
    size: int
    """Numbers of its values."""


def channels_of(sensor: str, settings: AnySensorDevice) -> tuple[SensorChannel, ...]:
    """Return the channels of a sensor; of a receiver positions, then velocities."""
    device, _, channel = settings.device.rpartition(".")
    unit, size = VALUES[sensor]
    first = SensorChannel(key="device", device=device, name=channel, unit=unit, size=size)
    if not isinstance(settings, GnssDevice):
        return (first,)
    unit, size = VELOCITIES
    second = SensorChannel(
        key="velocity", device=device, name=settings.velocity, unit=unit, size=size
    )
    return first, second


def sensors_from_devices(vehicle: Vehicle) -> Iterator[tuple[str, AnySensorDevice]]:
    """Yield name and settings of each sensor of a vehicle that is hardware."""
    for field in dataclasses.fields(vehicle.sensors):
        settings = getattr(vehicle.sensors, field.name)
        if settings is not None and not isinstance(settings, SensorNoise):
            yield field.name, settings
