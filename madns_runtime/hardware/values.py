"""Values of channels: brought into their shape, held to their limits. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from typing import Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel

EDGE_ROUNDING: Final = 1e-9
"""Share of a digit, and of a limit, that arithmetic may cost."""
NO_NUMBERS: Final = frozenset("USOcmM")
"""Kinds of numpy's elements that float() takes, by numpy's code of one letter: text, bytes, objects, complex, times."""


def to_numbers(channel: Channel, value: Any) -> tuple[float, ...]:
    """
    Return a value of a channel as its numbers, row by row; NaN and infinities are let through.

    Raises:
        PluginError: It has another shape, or holds what is no number.
    """
    try:
        numbers = tuple(map(_number, _flat(value) if channel.shape else (value,)))
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise PluginError(
            f"{channel.name}: expected {_wanted(channel)}, got {value!r:.80}"
        ) from None
    if len(numbers) != channel.size:
        raise PluginError(f"{channel.name}: expected {_wanted(channel)}, got {len(numbers)}")
    return numbers


def to_frame(channel: Channel, value: Any) -> bytes:
    """
    Return a frame's bytes.

    Raises:
        PluginError: It is no bytes, or too long.
    """
    if not isinstance(value, bytes | bytearray | memoryview):
        raise PluginError(f"{channel.name}: expected bytes, got {type(value).__name__}")
    data = bytes(value)
    if len(data) > channel.frame_bytes_max:
        raise PluginError(
            f"{channel.name}: expected at most {channel.frame_bytes_max} bytes, got {len(data)}"
        )
    return data


def from_hex(name: str, text: str) -> bytes:
    """
    Return the bytes that a parameter gives in hexadecimal digits.

    Raises:
        PluginError: They are none.
    """
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise PluginError(
            f"{name}: expected hexadecimal digits such as 00ff, got {text!r}"
        ) from None


def hold_to_limits(channel: Channel, numbers: Sequence[float]) -> tuple[tuple[float, ...], bool]:
    """Return numbers inside the channel's limits, and whether any was beyond."""
    if channel.limits is None:
        return tuple(numbers), False
    low, high = channel.limits
    held = tuple(min(max(number, low), high) for number in numbers)
    return held, held != tuple(numbers)


def nearest_whole(number: float, edges: tuple[float, float]) -> int:
    """
    Return the whole number nearest to a finite one; of one between two edges none beyond them, if there is one between.

    Args:
        number: In digits of a register or converter.
        edges: The limits of its channel in the same, in any order.
    """
    nearest, low, high = round(number), min(edges), max(edges)
    if not low <= number <= high:
        return nearest
    # The edges are quotients: one of 6.999999999999999 is 7.
    low -= EDGE_ROUNDING * max(1.0, abs(low))
    high += EDGE_ROUNDING * max(1.0, abs(high))
    other = nearest - 1 if nearest > high else nearest + 1
    return other if not low <= nearest <= high and low <= other <= high else nearest


def to_output(channel: Channel, value: Any) -> tuple[Any, bool]:
    """
    Return a value of an output as it is put out, numbers within the channel's limits, and whether it was beyond.

    Raises:
        PluginError: It is none of the channel's shape, or is no number.
    """
    if channel.is_frame:
        return to_frame(channel, value), False
    numbers = to_numbers(channel, value)
    if not are_finite(numbers):
        raise PluginError(f"{channel.name}: expected numbers, got {numbers}")
    return hold_to_limits(channel, numbers)


def check_range(name: str, low: float | None, high: float | None, scale: float) -> None:
    """
    Refuse parameters of a channel that hold no values.

    Raises:
        PluginError: One limit is given without the other, or the scale is zero.
    """
    if (low is None) != (high is None):
        raise PluginError(f"{name}: expected low and high, or neither; got {low} and {high}")
    if not scale or not math.isfinite(scale):
        raise PluginError(f"{name}: expected a scale other than 0, got {scale}")


def are_finite(numbers: Sequence[float]) -> bool:
    """Tell whether all are numbers."""
    return all(map(math.isfinite, numbers))


def from_numbers(channel: Channel, numbers: Sequence[float]) -> Any:
    """Return what a driver or an agent gets: a float for a number, else a tuple of all elements."""
    return tuple(numbers) if channel.shape else numbers[0]


def _number(value: Any) -> float:
    """
    Return one element as a number.

    Raises:
        TypeError: It is text or bytes, which float() would read, or else no number.
        ValueError, OverflowError: It has none that fits.
    """
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    if isinstance(value, str | bytes | bytearray | memoryview) or kind in NO_NUMBERS:
        raise TypeError("expected a number")
    return float(value)


def _flat(value: Any) -> Any:
    """Return the elements of nested sequences and arrays, row by row."""
    if hasattr(value, "ravel"):
        return value.ravel()
    if isinstance(value, str | bytes | bytearray | Mapping | Set):
        raise TypeError("expected numbers in an order")
    if isinstance(value, Sequence):
        return [element for row in value for element in (_flat(row) if _is_row(row) else (row,))]
    return value


def _is_row(value: Any) -> bool:
    return isinstance(value, Sequence) or hasattr(value, "ravel")


def _wanted(channel: Channel) -> str:
    return f"{channel.size} numbers" if channel.shape else "a number"
