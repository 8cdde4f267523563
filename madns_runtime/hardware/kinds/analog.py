"""`analog`: converters that Linux drives (Industrial I/O): one file per channel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import MinLen

from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.values import check_range

IIO = Path("/sys/bus/iio/devices")


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalogInput:
    """One input or output of a converter."""

    name: Annotated[str, MinLen(1)]
    file: Annotated[str, MinLen(1)]
    """Of the raw value, such as in_voltage0_raw, out_voltage0_raw; its scale and offset are found beside it."""
    unit: str = "mV"
    """Linux gives voltages in mV."""
    scale: float | None = None
    offset: float | None = None
    """value = (raw + offset) x scale; None for what the driver's own files say, else 1 and 0."""
    is_output: bool = False
    low: float | None = None
    high: float | None = None
    safe: float | None = None
    """Of an output: its limits and the value in which it harms nobody."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalogParameters:
    """Settings of an `analog` device."""

    inputs: Annotated[tuple[AnalogInput, ...], MinLen(1)]
    device: Annotated[str, MinLen(1)] = "iio:device0"
    """Name of the folder below /sys/bus/iio/devices."""
    root: str = str(IIO)
    """Folder of all converters."""


def channels_of(parameters: AnalogParameters) -> tuple[Channel, ...]:
    """
    Return a channel per file.

    Raises:
        PluginError: An input has one limit alone, or a scale of zero.
    """
    for each in parameters.inputs:
        check_range(each.name, each.low, each.high, 1.0 if each.scale is None else each.scale)
    return tuple(
        Channel(
            name=each.name,
            unit=each.unit,
            direction="out" if each.is_output else "in",
            limits=None if each.low is None or each.high is None else (each.low, each.high),
            safe=each.safe,
        )
        for each in parameters.inputs
    )


def needs_of(parameters: AnalogParameters) -> Needs:
    """Return the folder that must be there."""
    folder = f"{parameters.root}/{parameters.device}"
    outputs = tuple(f"{folder}/{each.file}" for each in parameters.inputs if each.is_output)
    return Needs(files=(folder,), exclusive=outputs)


kind = DeviceKind(
    name="analog",
    summary="analog inputs and outputs that Linux drives (Industrial I/O)",
    device="madns_runtime.hardware.drivers.analog:AnalogDevice",
    parameters=AnalogParameters,
    channels=channels_of,
    needs=needs_of,
)
