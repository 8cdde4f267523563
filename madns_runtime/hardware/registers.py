"""
Devices that are a map of registers behind a bus: what `i2c` and `spi` share.

A register holds one number or several of one type; raw numbers become values as raw x scale + offset.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Annotated, Any, Final, Literal, Protocol

from annotated_types import Ge, Le, MinLen

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.contract import Channel, Device, Sample, Value
from madns_runtime.hardware.values import check_range, nearest_whole, to_numbers

RegisterType = Literal[
    "u8", "i8", "u16_le", "u16_be", "i16_le", "i16_be", "u24_le", "u24_be", "i24_le", "i24_be",
    "u32_le", "u32_be", "i32_le", "i32_be", "f32_le", "f32_be",
]  # fmt: skip
BYTES: Final = {"8": 1, "16": 2, "24": 3, "32": 4}
ADDRESS_MAX: Final = 0xFF
F32_MAX: Final[float] = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]
"""The largest number that a float of 32 bits holds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Register:
    """One quantity of a device, at an address."""

    name: Annotated[str, MinLen(1)]
    """Name of the channel."""
    address: Annotated[int, Ge(0), Le(0xFF)]
    type: RegisterType = "u8"
    count: Annotated[int, Ge(1), Le(64)] = 1
    """Numbers one behind the other: 3 make a vector x, y, z."""
    shift: Annotated[int, Ge(0), Le(31)] = 0
    """Bits by which integers are shifted to the right, with their sign: 4 for 12 bits that stand left."""
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    period_s: Annotated[float, Ge(0)] = 0.0
    """It is read no more often than this, s; 0: each time."""
    direction: Literal["in", "out"] = "in"
    low: float | None = None
    high: float | None = None
    """Limits of the value; both or neither."""
    safe: float | None = None
    """out: the value in which it harms nobody."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterWrite:
    """Bytes that are written when the device is opened, such as those that wake it."""

    address: Annotated[int, Ge(0), Le(0xFF)]
    value: Annotated[int, Ge(0), Le(255)]


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterMap:
    """Figures of the device's data sheet, as far as they are used."""

    registers: Annotated[tuple[Register, ...], MinLen(1)]
    setup: tuple[RegisterWrite, ...] = ()
    """Written in this order when it is opened."""
    identity_address: Annotated[int, Ge(0), Le(0xFF)] | None = None
    """Register that tells which chip it is; it becomes the device's identity."""
    identity_value: Annotated[int, Ge(0), Le(255)] | None = None
    """Content that it must have."""


class RegisterBus(Protocol):
    """One device on a bus."""

    def read(self, address: int, count: int) -> bytes:
        """Return the bytes of registers from *address* on."""

    def write(self, address: int, data: bytes) -> None:
        """Write registers from *address* on."""

    def close(self) -> None:
        """Let go of the bus."""


def map_channels(given: RegisterMap) -> tuple[Channel, ...]:
    """
    Return a channel per register of a map.

    Raises:
        PluginError: A register has one limit alone, a scale of zero, no finite offset, or more bits to shift than it has,
            or those of a float; or there is an identity to compare and no register of it.
    """
    if given.identity_value is not None and given.identity_address is None:
        raise PluginError("map: identity_value needs identity_address: the register that holds it")
    for each in given.registers:
        check_range(each.name, each.low, each.high, each.scale)
        if not math.isfinite(each.offset):
            raise PluginError(f"{each.name}: expected a finite offset, got {each.offset}")
        if each.shift and each.type.startswith("f"):
            raise PluginError(f"{each.name}: shift is of integers, and {each.type} is none")
        if each.shift >= (bits := 8 * _width(each.type)):
            raise PluginError(
                f"{each.name}: shift: expected less than the {bits} bits of {each.type}, got {each.shift}"
            )
    return register_channels(given.registers)


def bytes_of(register: Register) -> int:
    """Return how many bytes the numbers of a register take."""
    return _width(register.type) * register.count


def register_channels(registers: Sequence[Register]) -> tuple[Channel, ...]:
    """Return a channel per register."""
    return tuple(
        Channel(
            name=each.name,
            unit=each.unit,
            shape=(each.count,) if each.count > 1 else (),
            components=("x", "y", "z") if each.count == 3 else (),
            direction=each.direction,
            rate_hz_max=1.0 / each.period_s if each.period_s else None,
            limits=_limits_of(each),
            safe=each.safe,
        )
        for each in registers
    )


def _limits_of(register: Register) -> tuple[float, float] | None:
    """
    Return the limits of a register's value; an output's are no wider than what its integers can hold.

    Raises:
        PluginError: They can hold none of an output's values.
    """
    low, high = register.low, register.high
    given = None if low is None or high is None else (low, high)
    if register.direction == "in" or register.type.startswith("f"):
        return given
    edges = (raw * register.scale + register.offset for raw in _raw_range(register))
    least, most = sorted(edges)
    if not math.isfinite(most - least):
        return given
    if given is None:
        return least, most
    if given[0] <= given[1] and not (given[0] <= most and least <= given[1]):
        raise PluginError(
            f"{register.name}: {register.type} holds {least:g} to {most:g}, none of {given[0]:g} to {given[1]:g}"
        )
    return max(given[0], least), min(given[1], most)


def _raw_range(register: Register) -> tuple[int, int]:
    """Return the least and the largest integer that a register holds."""
    bits = 8 * _width(register.type) - register.shift
    is_signed = register.type.startswith("i")
    return -(1 << bits - 1) if is_signed else 0, (1 << bits - int(is_signed)) - 1


class RegisterDevice(Device):
    """A map of registers; a kind's class says by `open_bus` what they lie behind."""

    def open_bus(self) -> RegisterBus:
        """Return the bus, opened."""
        raise NotImplementedError

    def open(self) -> str:
        """
        Check the identity, and write what wakes the device.

        Raises:
            MachineError: The bus cannot be opened, or another chip answers.
        """
        self._bus: RegisterBus | None = None
        self._read_s: dict[str, float] = {}
        self._bus = bus = self.open_bus()
        m = self.parameters.map
        identity = ""
        if m.identity_address is not None:
            found = bus.read(m.identity_address, 1)[0]
            identity = f"0x{found:02x}"
            if m.identity_value is not None and found != m.identity_value:
                raise MachineError(
                    f"expected 0x{m.identity_value:02x} in register 0x{m.identity_address:02x}, found {identity}:"
                    " another chip, or none, answers there"
                )
        for write in m.setup:
            bus.write(write.address, bytes((write.value,)))
        return identity

    def read(self) -> Sample | None:
        """Return the inputs whose period has passed."""
        taken_s = monotonic()
        values: dict[str, Value] = {}
        for register in self.parameters.map.registers:
            due_s = self._read_s.get(register.name, -1e9) + register.period_s
            if register.direction == "in" and taken_s >= due_s:
                self._read_s[register.name] = taken_s
                values[register.name] = self._value(register)
        if values:
            return Sample(values=values, taken_s=taken_s)
        return self._heartbeat(taken_s)

    def _heartbeat(self, taken_s: float) -> Sample | None:
        """Return a sample of no values from a device of outputs alone: its identity is read, so that its loss is seen."""
        m = self.parameters.map
        if any(register.direction == "in" for register in m.registers):
            return None
        if m.identity_address is not None:
            assert self._bus is not None
            self._bus.read(m.identity_address, 1)
        return Sample(values={}, taken_s=taken_s)

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """Write outputs, by name."""
        registers = {each.name: each for each in self.parameters.map.registers}
        for name, value in values.items():
            self._put(registers[name], value)

    def make_safe(self) -> None:
        """Write the safe value of each output that has one."""
        for register in self.parameters.map.registers if self._bus is not None else ():
            if register.direction == "out" and register.safe is not None:
                self._put(register, [register.safe] * register.count)

    def close(self) -> None:
        """Close the bus."""
        if self._bus is not None:
            self._bus.close()

    def _value(self, register: Register) -> Value:
        assert self._bus is not None
        width = _width(register.type)
        data = self._bus.read(register.address, width * register.count)
        numbers = [
            decode_number(register.type, data[start : start + width], register.shift)
            * register.scale
            + register.offset
            for start in range(0, width * register.count, width)
        ]
        return numbers if register.count > 1 else numbers[0]

    def _put(self, register: Register, value: Any) -> None:
        assert self._bus is not None
        channel = register_channels([register])[0]
        numbers = to_numbers(channel, value if register.count > 1 else _first(value))
        raw = [(number - register.offset) / register.scale for number in numbers]
        if channel.limits is not None and not register.type.startswith("f"):
            first, last = ((each - register.offset) / register.scale for each in channel.limits)
            # Infinite ones are held to what the register can hold.
            raw = [nearest_whole(n, (first, last)) if math.isfinite(n) else n for n in raw]
        data = b"".join(encode_number(register.type, number, register.shift) for number in raw)
        self._bus.write(register.address, data)


def decode_number(kind: RegisterType, data: bytes, shift: int) -> float:
    """Return the number that bytes of a register hold."""
    order: Literal["little", "big"] = "big" if kind.endswith("_be") else "little"
    if kind.startswith("f"):
        return float(struct.unpack("<f" if order == "little" else ">f", data)[0])
    return float(int.from_bytes(data, order, signed=kind.startswith("i")) >> shift)


def encode_number(kind: RegisterType, number: float, shift: int) -> bytes:
    """Return the bytes of a number, held to what the register can hold."""
    order: Literal["little", "big"] = "big" if kind.endswith("_be") else "little"
    # No integer of a register is larger, and infinity would be none.
    held = min(max(number, -F32_MAX), F32_MAX)
    if kind.startswith("f"):
        return struct.pack("<f" if order == "little" else ">f", held)
    width, is_signed = _width(kind), kind.startswith("i")
    bits = 8 * width - shift
    low = -(1 << bits - 1) if is_signed else 0
    high = (1 << bits - int(is_signed)) - 1
    # Held before it is shifted: the bits below it may mean something else to the chip.
    raw = min(max(round(held), low), high) << shift
    return raw.to_bytes(width, order, signed=is_signed)


def _width(kind: str) -> int:
    return BYTES[kind[1:].partition("_")[0]]


def _first(value: Any) -> Any:
    return value[0] if isinstance(value, list | tuple) else value
