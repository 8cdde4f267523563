"""`emulated_mcu`: a microcontroller with its real firmware, emulated by QEMU, with sensors that truth sets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from annotated_types import Ge, Gt, Le, MinLen

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs

HELD: Final = "_held"
"""After a sensor's name: the input with the values that the emulated sensor holds."""
CHUNK_BYTES_MAX: Final = 4096
"""Bytes of the serial line that are handed over at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatedSensor:
    """A sensor on the microcontroller's bus; its registers follow values that are set from outside."""

    name: Annotated[str, MinLen(1)]
    """Name of the output that sets it, such as magnetometer."""
    model: Annotated[str, MinLen(1)]
    """QEMU's name for it, such as lsm303dlhc_mag."""
    address: Annotated[int, Ge(0), Le(0x7F)] | None = None
    """Address on its bus; none for the model's own."""
    properties: Annotated[tuple[str, ...], MinLen(1)]
    """Properties of the model that hold its values, one per element, such as mag-x."""
    components: tuple[str, ...] = ()
    """Names of the elements, such as x, y, z; empty for 1, 2, 3, ..."""
    unit: str = ""
    """Unit of the values."""
    counts_per_unit: Annotated[float, Gt(0)] = 1.0
    """Integers of the model's properties per unit, such as 1e9 for nT."""
    limits: tuple[float, float]
    """Least and largest value that the model takes; others are held to them."""


LSM303_MAGNETOMETER: Final = EmulatedSensor(
    name="magnetometer",
    model="lsm303dlhc_mag",
    address=0x1E,
    properties=("mag-x", "mag-y", "mag-z"),
    components=("x", "y", "z"),
    unit="T",
    counts_per_unit=1e9,
    limits=(0.0, 1.7e-4),
)
"""ST's LSM303DLHC. QEMU's model takes no negative field: an offset, as of hard iron, keeps values above 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatedMcuParameters:
    """Settings of an `emulated_mcu`."""

    firmware: Path
    """Image: an ELF file, or Intel HEX with loading: device."""
    machine: Annotated[str, MinLen(1)] = "lm3s6965evb"
    """Board, by QEMU's name: see `qemu-system-arm -M help`."""
    loading: Literal["kernel", "device"] = "kernel"
    """kernel: as -kernel; device: as -device loader, which reads Intel HEX, too."""
    sensors: tuple[EmulatedSensor, ...] = (LSM303_MAGNETOMETER,)
    """Sensors on the board's first bus."""
    serial_port: Annotated[int, Ge(0), Le(3)] = 0
    """Number of the serial line that is connected."""
    program: Annotated[str, MinLen(1)] = "qemu-system-arm"
    """The emulator."""
    gather_s: Annotated[float, Ge(0), Le(1)] = 0.002
    """Bytes that the serial line brings within so long of each other's first are handed over together, s."""
    line_bytes_s: Annotated[float, Ge(4096), Le(1e7)] = 92_160.0
    """Bytes per second that the serial line brings at most, as a UART at 921600 baud; an emulated one has no rate of its
    own. What firmware sends beyond, after a burst of as many as in one second, is lost and counted."""
    held_hz: Annotated[float, Gt(0), Le(100)] = 10.0
    """Rate at which is read back what the sensors hold, Hz."""


def channels_of(parameters: EmulatedMcuParameters) -> tuple[Channel, ...]:
    """
    Return the serial line, both ways, and of each sensor what sets it and what it holds.

    Raises:
        PluginError: A sensor has no properties of its own, or the name of another channel.
    """
    line = (
        Channel(name="received", is_frame=True, frame_bytes_max=CHUNK_BYTES_MAX, passing="queue"),
        Channel(
            name="sent",
            direction="out",
            is_frame=True,
            frame_bytes_max=CHUNK_BYTES_MAX,
            passing="queue",
        ),
    )
    sensors = []
    for sensor in parameters.sensors:
        if len(set(sensor.properties)) < len(sensor.properties):
            raise PluginError(f"sensors: {sensor.name}: expected each property once")
        shape = (len(sensor.properties),) if len(sensor.properties) > 1 else ()
        for name, direction in ((sensor.name, "out"), (f"{sensor.name}{HELD}", "in")):
            sensors.append(
                Channel(
                    name=name,
                    unit=sensor.unit,
                    shape=shape,
                    components=sensor.components,
                    direction="out" if direction == "out" else "in",
                    limits=sensor.limits,
                )
            )
    return (*line, *sensors)


def needs_of(parameters: EmulatedMcuParameters) -> Needs:
    """Return the package that brings the emulator."""
    is_own = "/" in parameters.program
    return Needs(packages=() if is_own else (parameters.program,))


kind = DeviceKind(
    name="emulated_mcu",
    summary="a microcontroller with its firmware, emulated by QEMU: serial line, sensors on its bus",
    device="madns_runtime.hardware.drivers.emulated_mcu:EmulatedMcu",
    parameters=EmulatedMcuParameters,
    channels=channels_of,
    needs=needs_of,
    files=("firmware",),
    needs_hardware=False,
)
