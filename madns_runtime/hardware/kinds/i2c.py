"""`i2c`: a device on an I2C bus, described by a map of its registers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from annotated_types import Ge, Le

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.registers import (
    ADDRESS_MAX,
    RegisterMap,
    bytes_of,
    map_channels,
)

BLOCK_BYTES: Final = 32
"""A block of the system management bus is no longer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class I2cParameters:
    """Settings of an `i2c` device."""

    map: RegisterMap
    address: Annotated[int, Ge(0x03), Le(0x77)]
    """Of the device on the bus, 7 bits."""
    bus: Annotated[int, Ge(0), Le(255)] = 1
    """Number of the bus: 1 is /dev/i2c-1, that of a Raspberry Pi's header."""


def channels_of(parameters: I2cParameters) -> tuple[Channel, ...]:
    """
    Return a channel per register.

    Raises:
        PluginError: As `map_channels`, or a block of one begins where there is no register.
    """
    channels = map_channels(parameters.map)
    for each in parameters.map.registers:
        size = bytes_of(each)
        if each.address + (size - 1) // BLOCK_BYTES * BLOCK_BYTES > ADDRESS_MAX:
            # The bus would take such an address modulo 256, and other registers would be read or written.
            raise PluginError(
                f"{each.name}: {size} bytes from register 0x{each.address:02x} on, in blocks of {BLOCK_BYTES}, go beyond"
                f" register 0x{ADDRESS_MAX:02x}"
            )
    return channels


def needs_of(parameters: I2cParameters) -> Needs:
    """Return what the bus needs."""
    return Needs(
        groups=("i2c",),
        boot_lines=("dtparam=i2c_arm=on",),
        files=(f"/dev/i2c-{parameters.bus}",),
        requirements=("smbus2>=0.4",),
        exclusive=(f"i2c-{parameters.bus} 0x{parameters.address:02x}",),
    )


kind = DeviceKind(
    name="i2c",
    summary="a device on an I2C bus, by a map of its registers",
    device="madns_runtime.hardware.drivers.i2c:I2cDevice",
    parameters=I2cParameters,
    channels=channels_of,
    needs=needs_of,
)
