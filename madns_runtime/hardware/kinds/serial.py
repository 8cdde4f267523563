"""`serial`: frames over a serial line: RS-232, RS-422 and RS-485, USB adapters, pseudo-terminals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from annotated_types import Ge, Le, MinLen

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.framing import Framing, make_framer
from madns_runtime.hardware.values import from_hex

LINES: Final[tuple[Framing, ...]] = ("lines", "nmea")
"""Framings whose frames are lines without their ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialParameters:
    """Settings of a `serial` device."""

    port: Annotated[str, MinLen(1)]
    """Device file, such as /dev/ttyUSB0 or /dev/serial/by-id/...: the second stays the same at every start."""
    baud_rate: Annotated[int, Ge(50), Le(4_000_000)] = 115_200
    data_bits: Literal[5, 6, 7, 8] = 8
    parity: Literal["none", "even", "odd", "mark", "space"] = "none"
    stop_bits: Literal[1, 2] = 1
    flow_control: Literal["none", "rts_cts", "xon_xoff", "dsr_dtr"] = "none"
    electrical: Literal["rs232", "rs422", "rs485"] = "rs232"
    """rs485: the driver switches the direction by RTS; rs422 needs nothing of it."""
    rs485_rts_level_for_tx: bool = True
    rs485_delay_before_tx_s: Annotated[float, Ge(0), Le(1)] = 0.0
    framing: Framing = "lines"
    frame_bytes_max: Annotated[int, Ge(1), Le(8192)] = 1024
    length_bytes: Annotated[int, Ge(1), Le(4)] = 2
    """length_prefixed: bytes of the length."""
    length_order: Literal["little", "big"] = "little"
    safe_frame_hex: str = ""
    """Frame that brings what hangs on the line into a safe state, hexadecimal; empty: nothing is sent."""


def channels_of(parameters: SerialParameters) -> tuple[Channel, ...]:
    """
    Return what comes and what goes.

    Raises:
        PluginError: The safe frame is no hexadecimal text, too long, or none that the framing could carry.
    """
    p = parameters
    frame_bytes_max = p.frame_bytes_max
    if p.framing == "length_prefixed":
        frame_bytes_max = min(frame_bytes_max, (1 << 8 * p.length_bytes) - 1)
    safe_frame = from_hex("safe_frame_hex", p.safe_frame_hex)
    if len(safe_frame) > frame_bytes_max:
        raise PluginError(
            f"safe_frame_hex: expected at most {frame_bytes_max} bytes, got {len(safe_frame)}"
        )
    if safe_frame:
        try:
            make_framer(p.framing, p.frame_bytes_max, p.length_bytes, p.length_order).wrap(
                safe_frame
            )
        except PluginError as error:
            raise PluginError(f"safe_frame_hex: {error}") from None
    shared: dict[str, Any] = {
        "is_frame": True,
        "frame_bytes_max": frame_bytes_max,
        "passing": "queue",
        "is_line": p.framing in LINES,
    }
    return (
        Channel(name="received", **shared),
        Channel(name="sent", direction="out", **shared),
    )


kind = DeviceKind(
    name="serial",
    summary="frames over a serial line (RS-232, RS-422, RS-485, USB, pty)",
    device="madns_runtime.hardware.drivers.serial:SerialDevice",
    parameters=SerialParameters,
    channels=channels_of,
    needs=Needs(groups=("dialout",), requirements=("pyserial>=3.5",)),
    can_block=True,
)
