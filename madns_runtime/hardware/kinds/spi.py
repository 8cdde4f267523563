"""`spi`: a device on an SPI bus, described by a map of its registers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.registers import (
    RegisterMap,
    map_channels,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpiParameters:
    """Settings of an `spi` device."""

    map: RegisterMap
    bus: Annotated[int, Ge(0), Le(255)] = 0
    chip_select: Annotated[int, Ge(0), Le(255)] = 0
    """/dev/spidev<bus>.<chip_select>."""
    mode: Literal[0, 1, 2, 3] = 0
    speed_hz: Annotated[int, Ge(1000), Le(125_000_000)] = 1_000_000
    read_bits: Annotated[int, Ge(0), Le(255)] = 0x80
    """Bits that are set in the address to read."""
    increment_bits: Annotated[int, Ge(0), Le(255)] = 0
    """Further bits for more than one byte, as some chips want them (0x40)."""


def channels_of(parameters: SpiParameters) -> tuple[Channel, ...]:
    """Return a channel per register."""
    return map_channels(parameters.map)


def needs_of(parameters: SpiParameters) -> Needs:
    """Return what the bus needs."""
    return Needs(
        groups=("spi",),
        boot_lines=("dtparam=spi=on",),
        files=(f"/dev/spidev{parameters.bus}.{parameters.chip_select}",),
        # There is no wheel of it.
        packages=("python3-spidev",),
        system_modules=("spidev",),
        exclusive=(f"spidev{parameters.bus}.{parameters.chip_select}",),
    )


kind = DeviceKind(
    name="spi",
    summary="a device on an SPI bus, by a map of its registers",
    device="madns_runtime.hardware.drivers.spi:SpiDevice",
    parameters=SpiParameters,
    channels=channels_of,
    needs=needs_of,
)
