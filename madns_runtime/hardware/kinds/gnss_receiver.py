"""`gnss_receiver`: plays a GNSS receiver on a serial line, from truth: UBX and NMEA for somebody's flight computer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Le, MinLen

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.gnss_messages import GnssMessage

BaudRate = Literal[4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600]
UTC_S_MAX = 7_605_187_200.0
"""The end of 2210: a run begins before 2200 and lasts ten years at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssReceiverParameters:
    """Settings of a `gnss_receiver`."""

    link: Path | None = None
    """Link to the pseudo-terminal that it makes, removed at the end; ${name} is the agent's name (of a device of the
    inventory the machine's), by which receivers are told apart."""
    port: str = ""
    """Serial port that it writes to instead, such as /dev/ttyUSB0."""
    baud_rate: BaudRate = 115_200
    """Of the port."""
    messages: Annotated[tuple[GnssMessage, ...], MinLen(1)] = (
        "NAV-PVT",
        "NAV-HPPOSECEF",
        "NAV-TIMEUTC",
    )
    """Messages of each epoch, in this order."""
    leap_seconds: Annotated[int, Ge(0), Le(127)] | None = None
    """GPS time minus UTC, s; without it what it was at each epoch: 13 in 2000, 18 since 2017."""
    position_accuracy_m: Annotated[float, Ge(0), Le(10_000)] = 2.5
    """Accuracy that it tells of position; no error is added."""
    velocity_accuracy_m_s: Annotated[float, Ge(0), Le(1000)] = 0.05
    time_accuracy_ns: Annotated[int, Ge(0), Le(1_000_000_000)] = 30
    satellites: Annotated[int, Ge(0), Le(99)] = 12
    """Satellites in use that it tells."""
    dilution: Annotated[float, Ge(0), Le(99)] = 1.2
    """Dilution of precision that it tells."""
    geoid_m: Annotated[float, Ge(-200), Le(200)] = 0.0
    """Height of the geoid above the ellipsoid that it tells, everywhere: it has no model of it."""


def channels_of(parameters: GnssReceiverParameters) -> tuple[Channel, ...]:
    """
    Return the count of epochs that went out, and the epoch that it takes.

    Raises:
        PluginError: It is to write to both a port and a pseudo-terminal, or to neither.
    """
    if (parameters.link is None) != bool(parameters.port):
        raise PluginError("expected a link to its pseudo-terminal, or a port that it writes to")
    return (
        Channel(name="epochs"),
        Channel(
            name="epoch",
            direction="out",
            shape=(7,),
            components=("utc_s", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s"),
            limits=(-UTC_S_MAX, UTC_S_MAX),
        ),
    )


def needs_of(parameters: GnssReceiverParameters) -> Needs:
    """Return what a port needs; a pseudo-terminal needs nothing."""
    return Needs(groups=("dialout",)) if parameters.port else Needs()


kind = DeviceKind(
    name="gnss_receiver",
    summary="plays a GNSS receiver from truth: UBX and NMEA on a serial line or a pty",
    device="madns_runtime.hardware.drivers.gnss_receiver:GnssReceiver",
    parameters=GnssReceiverParameters,
    channels=channels_of,
    needs=needs_of,
    can_block=False,
    needs_hardware=False,
)
