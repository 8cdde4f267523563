"""
Ways to flight software outside the agent's process, as a person writes them in a scenario.

As in `parameters`: frozen dataclasses with bounds, the standard library and annotated_types alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MinLen

PROTOCOLS = ("json_lines", "frames", "space_packets")
SOCKET_PATH_BYTES_MAX = 107
"""Of a Unix socket's path: sun_path of Linux without its last zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StdioTransport:
    """Standard input and output of the program."""

    kind: Literal["stdio"]
    """stdio"""


@dataclass(frozen=True, slots=True, kw_only=True)
class PtyTransport:
    """A pseudo-terminal that the agent opens; the program is given its name as ${pty}, and the log tells it."""

    kind: Literal["pty"]
    """pty"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialTransport:
    """A serial port of the agent's machine: extra `hardware`."""

    kind: Literal["serial"]
    """serial"""
    port: Annotated[str, MinLen(1)]
    """Device file, such as /dev/ttyUSB0."""
    baud_rate: Annotated[int, Ge(50), Le(20_000_000)] = 115_200
    """Bits per second; eight data bits, no parity, one stop bit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TcpTransport:
    """One TCP connection."""

    kind: Literal["tcp"]
    """tcp"""
    address: Annotated[str, MinLen(3)]
    """HOST:PORT to connect to, or to listen at; port 0 for a free one, which the program is given as ${address}."""
    listen: bool = False
    """Whether the software connects to the agent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UdpTransport:
    """Datagrams, one for each line, frame or packet."""

    kind: Literal["udp"]
    """udp"""
    local: Annotated[str, MinLen(3)]
    """HOST:PORT to receive at; port 0 for a free one, which the program is given as ${address}."""
    remote: str | None = None
    """HOST:PORT to send to; none for wherever the first datagram comes from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnixTransport:
    """One connection over a Unix socket."""

    kind: Literal["unix"]
    """unix"""
    path: Annotated[str, MinLen(1)]
    """Path of the socket, found from the scenario's folder."""
    listen: bool = False
    """Whether the software connects to the agent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceTransport:
    """A device of the run, such as a serial line that its own process drives."""

    kind: Literal["device"]
    """device"""
    device: Annotated[str, MinLen(1)]
    """Name of the device among the agent's hardware: bytes come by its queue `received` and leave by `sent`."""
    recorded: bool = False
    """Whether the device plays back what was recorded: its answers come at their own times, and no tick waits for them."""


AnyTransport = (
    StdioTransport
    | PtyTransport
    | SerialTransport
    | TcpTransport
    | UdpTransport
    | UnixTransport
    | DeviceTransport
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightInterface:
    """Way of bytes to flight software, and their meaning."""

    transport: AnyTransport = field(default_factory=lambda: StdioTransport(kind="stdio"))
    """Way of bytes."""
    protocol: Annotated[str, MinLen(3)] = "json_lines"
    """json_lines, frames, space_packets, or file.py:Class of one's own."""
    clock: Literal["stepped", "own"] = "stepped"
    """stepped: each tick is answered; own: software that runs free and answers when it likes, in real time only."""
    start_s: Annotated[float, Gt(0), Le(3600)] = 10.0
    """Time for the software to be there, s."""


def is_played_back(interface: FlightInterface | None) -> bool:
    """Tell whether the answers of flight software come from a recording."""
    transport = None if interface is None else interface.transport
    return isinstance(transport, DeviceTransport) and transport.recorded
