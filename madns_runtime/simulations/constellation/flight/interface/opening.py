"""Makes the transport and the protocol that a scenario names."""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol, assert_never

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.plugin.context import describe_exception
from madns_runtime.plugin.isolation import is_from_outside
from madns_runtime.plugin.registry import load_function
from madns_runtime.simulations.constellation import interface_settings as settings
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer
from madns_runtime.simulations.constellation.flight.interface.frames import Frames
from madns_runtime.simulations.constellation.flight.interface.json_lines import JsonLines
from madns_runtime.simulations.constellation.flight.interface.local_transports import (
    DeviceLink,
    PtyLink,
    SerialLink,
    StdioLink,
    find_device,
    socket_path,
)
from madns_runtime.simulations.constellation.flight.interface.own_protocol import OwnProtocol
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport
from madns_runtime.simulations.constellation.flight.interface.socket_transports import (
    SocketLink,
    UdpLink,
    resolve,
    resolve_both,
)
from madns_runtime.simulations.constellation.flight.interface.space_packets import SpacePackets
from madns_runtime.simulations.constellation.flight.interface.transport import Transport
from madns_runtime.simulations.constellation.substitution import substitute

METHODS: Final = ("setup", "tick", "feed")
"""Of a protocol."""


class FlightProtocol(Protocol):
    """
    The meaning of bytes: pure, and made without arguments, one for each vehicle.

    It may have `faults`, a mapping of kinds to counts of what it could not take, and `answers_by_time`: true if each
    answer names its tick (the default), false if they come one for each tick in order.
    """

    def setup(self, setup: SetupReport) -> Sequence[bytes]:
        """Return the packets that tell the software who it is."""

    def tick(self, tick: TickReport) -> Sequence[bytes]:
        """Return the packets of a tick."""

    def feed(self, data: bytes) -> Sequence[FlightAnswer]:
        """Take bytes, cut anywhere, and return the answers that are whole now; never raises."""


PROTOCOLS: Final[Mapping[str, type[Any]]] = {
    "json_lines": JsonLines,
    "frames": Frames,
    "space_packets": SpacePackets,
}


def make_protocol(name: str, base_directory: Path) -> FlightProtocol:
    """
    Return a protocol.

    Raises:
        BlamedError: It cannot be found, does not load, or lacks what a protocol has.
    """
    made = PROTOCOLS.get(name)
    try:
        protocol = (made or load_function(name, base_directory))()
    except PluginError as error:
        raise BlamedError(f"interface.protocol: {error}") from error
    except BaseException as error:  # of a user's class
        if is_from_outside(error):
            raise
        raise BlamedError(
            f"interface.protocol: {describe_exception(error, f'{name}: making it, without arguments,')}"
        ) from error
    lacking = [each for each in METHODS if not callable(getattr(protocol, each, None))]
    if lacking:
        raise BlamedError(f"interface.protocol: {name}: expected the methods {', '.join(lacking)}")
    ready: FlightProtocol = protocol if made else OwnProtocol(protocol)
    return ready


def make_transport(
    interface: settings.FlightInterface,
    values: Mapping[str, str],
    base_directory: Path,
    devices: Mapping[str, Any],
) -> Transport:
    """
    Return a transport, not yet open.

    Args:
        interface: From the scenario.
        values: What stands for ${name} and the others in its addresses.
        base_directory: Folder of the scenario.
        devices: Those that the agent uses.

    Raises:
        BlamedError: An address is none, or there is no such device.
    """
    given = interface.transport
    match given:
        case settings.StdioTransport():
            return StdioLink("stdio")
        case settings.PtyTransport():
            return PtyLink("pty")
        case settings.SerialTransport():
            return SerialLink(substitute(given.port, values), given.baud_rate)
        case settings.TcpTransport():
            address = substitute(given.address, values)
            family, place = resolve(address, socket.SOCK_STREAM, "transport.address")
            return SocketLink(f"tcp {address}", family, place, listens=given.listen)
        case settings.UnixTransport():
            path = socket_path(substitute(given.path, values), base_directory)
            return SocketLink(f"unix {path}", socket.AF_UNIX, path, listens=given.listen)
        case settings.UdpTransport():
            return _udp(given, values)
        case settings.DeviceTransport():
            device = find_device(devices, substitute(given.device, values))
            is_stream = interface.protocol in settings.PROTOCOLS
            return DeviceLink(device, protocol=interface.protocol if is_stream else "")
        case _:
            assert_never(given)


def _udp(given: settings.UdpTransport, values: Mapping[str, str]) -> UdpLink:
    local = substitute(given.local, values)
    family, place = resolve(local, socket.SOCK_DGRAM, "transport.local")
    remote = None
    if given.remote is not None:
        there = substitute(given.remote, values)
        family, place, remote = resolve_both(local, there)
    return UdpLink(f"udp {local}", place, remote, family=family)
