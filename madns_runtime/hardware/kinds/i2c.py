"""`i2c`: a device on an I2C bus, described by a map of its registers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.registers import (
    RegisterMap,
    map_channels,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class I2cParameters:
    """Settings of an `i2c` device."""

    map: RegisterMap
    address: Annotated[int, Ge(0x03), Le(0x77)]
    """Of the device on the bus, 7 bits."""
    bus: Annotated[int, Ge(0), Le(255)] = 1
    """Number of the bus: 1 is /dev/i2c-1, that of a Raspberry Pi's header."""


def channels_of(parameters: I2cParameters) -> tuple[Channel, ...]:
    """Return a channel per register."""
    return map_channels(parameters.map)


def needs_of(parameters: I2cParameters) -> Needs:
    """Return what the bus needs."""
    return Needs(
        groups=("i2c",),
        boot_lines=("dtparam=i2c_arm=on",),
        files=(f"/dev/i2c-{parameters.bus}",),
        requirements=("smbus2>=0.4",),
    )


kind = DeviceKind(
    name="i2c",
    summary="a device on an I2C bus, by a map of its registers",
    device="madns_runtime.hardware.drivers.i2c:I2cDevice",
    parameters=I2cParameters,
    channels=channels_of,
    needs=needs_of,
)
