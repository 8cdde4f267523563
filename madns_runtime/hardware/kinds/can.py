"""`can`: frames of a CAN bus, by the kernel's sockets or by python-can."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal

from annotated_types import Ge, Le, MinLen

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs

EXTENDED: Final = 0x8000_0000
"""Bit of an identifier of 29 bits."""
HEAD_BYTES: Final = 4
"""A frame of ours: identifier (little-endian, bit 31 set for 29 bits), then 0 to 8 bytes of data."""


DATA_BYTES_MAX: Final = 8
STANDARD_DIGITS: Final = 3
"""Of an identifier of 11 bits; one of 29 bits is written with more."""
IDENTIFIER: Final = re.compile(r"[0-9A-Fa-f]{1,8}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CanFilter:
    """Frames that are wanted: those whose identifier equals this one where the mask has ones."""

    identifier: Annotated[int, Ge(0), Le(0x1FFF_FFFF)]
    mask: Annotated[int, Ge(0), Le(0x1FFF_FFFF)] = 0x1FFF_FFFF


@dataclass(frozen=True, slots=True, kw_only=True)
class CanParameters:
    """Settings of a `can` device."""

    interface: Annotated[str, MinLen(1)] = "can0"
    """Network interface, or channel of a python-can interface."""
    library: Literal["socket", "python-can"] = "socket"
    """socket: the kernel's (Linux); python-can: any interface that it knows (extra can)."""
    python_can_interface: str = "socketcan"
    """python-can: its name for the kind of interface, such as slcan, pcan, virtual."""
    bit_rate: Annotated[int, Ge(1000), Le(1_000_000)] | None = None
    """python-can: bits per second; a socket's is set by `ip link`."""
    filters: tuple[CanFilter, ...] = ()
    """Frames that are taken; empty for all."""
    safe_frames_hex: tuple[str, ...] = field(default_factory=tuple)
    """Frames that bring what hangs on the bus into a safe state: identifier#data as candump writes, such as 123#00FF."""


def channels_of(parameters: CanParameters) -> tuple[Channel, ...]:
    """
    Return what comes and what goes: 4 bytes of identifier, then the data.

    Raises:
        PluginError: A safe frame is none.
    """
    for text in parameters.safe_frames_hex:
        frame_of(text)
    shared: dict[str, Any] = {
        "is_frame": True,
        "frame_bytes_max": HEAD_BYTES + DATA_BYTES_MAX,
        "passing": "queue",
    }
    return (
        Channel(name="received", **shared),
        Channel(name="sent", direction="out", **shared),
    )


def frame_of(text: str) -> tuple[int, bytes]:
    """
    Return identifier (bit 31 set for 29 bits) and data of a frame as candump writes it, such as 123#00FF.

    Raises:
        PluginError: It is none.
    """
    number, mark, digits = text.partition("#")
    try:
        identifier, data = int(number, 16), bytes.fromhex(digits)
    except ValueError:
        mark = ""
    is_extended = len(number) > STANDARD_DIGITS
    # What else int() takes, such as 0x123, would become an identifier of 29 bits.
    if (
        not mark
        or not IDENTIFIER.fullmatch(number)
        or identifier >> (29 if is_extended else 11)
        or len(data) > DATA_BYTES_MAX
    ):
        raise PluginError(f"safe_frames_hex: expected a frame such as 123#00FF, got {text!r}")
    return identifier | (EXTENDED if is_extended else 0), data


def needs_of(parameters: CanParameters) -> Needs:
    """Return what the bus needs."""
    if parameters.library == "python-can":
        return Needs(requirements=("python-can>=4.3",))
    return Needs(files=(f"/sys/class/net/{parameters.interface}",))


kind = DeviceKind(
    name="can",
    summary="frames of a CAN bus (the kernel's sockets, or python-can)",
    device="madns_runtime.hardware.drivers.can:CanDevice",
    parameters=CanParameters,
    channels=channels_of,
    needs=needs_of,
)
