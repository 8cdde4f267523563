"""
`sense_hat`: the Raspberry Pi's Sense HAT: inertial sensors, environment, LED matrix, joystick.

Ranges and accuracies are those of its data sheets, as the thesis lists them (section 5.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from annotated_types import Ge

from madns_runtime.hardware.contract import Channel, DeviceKind, Needs

XYZ: Final = ("x", "y", "z")


G0: Final = 9.80665
"""Standard gravity, m/s2."""


PIXELS: Final = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class SenseHatParameters:
    """Settings of a `sense_hat` device."""

    rotation: Literal[0, 90, 180, 270] = 0
    """Of the picture on the LED matrix, deg."""
    accelerometer: bool = True
    gyroscope: bool = True
    magnetometer: bool = True
    """Which inertial sensors are read: each costs time."""
    environment_period_s: Annotated[float, Ge(0)] = 1.0
    """Temperature, pressure and humidity are read no more often than this, s; 0: each time."""
    joystick: bool = True
    emulated: bool = False
    """Whether the program of the emulator (sense_emu) stands in for the HAT."""


def channels_of(parameters: SenseHatParameters) -> tuple[Channel, ...]:
    """Return the channels of what is read and shown."""
    found = []
    if parameters.accelerometer:
        found.append(_vector("accelerometer", "m/s2", 16 * G0))
    if parameters.gyroscope:
        found.append(_vector("gyroscope", "rad/s", math.radians(2000)))
    if parameters.magnetometer:
        found.append(_vector("magnetometer", "T", 16e-4))
    period_s = parameters.environment_period_s
    given_hz = 1.0 / period_s if period_s else math.inf
    slow_hz, fast_hz = min(12.5, given_hz), min(25.0, given_hz)
    found += [
        Channel(name="temperature", unit="degC", limits=(0.0, 80.0), rate_hz_max=slow_hz),
        Channel(name="pressure", unit="hPa", limits=(260.0, 1260.0), rate_hz_max=fast_hz),
        Channel(name="humidity", unit="%", limits=(0.0, 100.0), rate_hz_max=slow_hz),
    ]
    if parameters.joystick:
        found.append(
            Channel(
                name="joystick", shape=(2,), components=("direction", "action"), passing="queue"
            )
        )
    matrix = Channel(
        name="matrix",
        shape=(PIXELS, 3),
        direction="out",
        limits=(0.0, 255.0),
        safe=0.0,
        rate_hz_max=60.0,
    )
    return (*found, matrix)


def needs_of(parameters: SenseHatParameters) -> Needs:
    """Return what the HAT needs: its library comes with the system alone, the inertial one has no wheel."""
    if parameters.emulated:
        return Needs(requirements=("sense-emu>=1.2",))
    return Needs(
        packages=("sense-hat",),
        groups=("i2c", "input", "video"),
        boot_lines=("dtparam=i2c_arm=on",),
        files=("/dev/i2c-1", "/dev/fb*"),
        system_modules=("sense_hat", "RTIMU"),
        exclusive=("the Sense HAT",),
    )


def _vector(name: str, unit: str, largest: float) -> Channel:
    return Channel(
        name=name,
        unit=unit,
        shape=(3,),
        components=XYZ,
        limits=(-largest, largest),
        rate_hz_max=60.0,
    )


kind = DeviceKind(
    name="sense_hat",
    summary="the Raspberry Pi's Sense HAT: inertial sensors, environment, LED matrix, joystick",
    device="madns_runtime.hardware.drivers.sense_hat:SenseHatDevice",
    parameters=SenseHatParameters,
    channels=channels_of,
    needs=needs_of,
    rate_hz=20.0,
    rate_hz_max=60.0,
)
