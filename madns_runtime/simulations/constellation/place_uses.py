"""
Places of its machine that each vehicle's way to its flight software takes for itself: ports, sockets, serial lines.

As in `check`, for which it answers: nothing of it is run.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from pathlib import Path
from typing import assert_never

from madns_runtime.plugin.api import PlaceUse
from madns_runtime.simulations.constellation.flight_settings import FlightClass, FlightRule
from madns_runtime.simulations.constellation.interface_settings import (
    DeviceTransport,
    FlightInterface,
    PtyTransport,
    SerialTransport,
    StdioTransport,
    TcpTransport,
    UdpTransport,
    UnixTransport,
)
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.substitution import substitute
from madns_runtime.simulations.constellation.vehicles import flight_of, flight_rules

ANY_HOST = frozenset(("", "0.0.0.0", "::", "*"))


def uses_places(parameters: ConstellationParameters) -> bool:
    """Tell whether any vehicle may use one: most scenarios have none, and need not choose their satellites."""
    return any(interface_of(rule) is not None for rule in flight_rules(parameters))


def interface_of(rule: FlightRule | None) -> FlightInterface | None:
    """Return the way to flight software; None if it has none of its own."""
    return None if rule is None or isinstance(rule, FlightClass) else rule.interface


def place_uses_of(
    parameters: ConstellationParameters, satellites: dict[str, str], base_directory: Path
) -> Iterator[PlaceUse]:
    """
    Yield what each vehicle takes.

    Args:
        parameters: Of the scenario.
        satellites: Names of satellites by those of agents, in order.
        base_directory: Folder of the scenario.
    """
    rules = flight_rules(parameters)
    fields: list[tuple[str, str, str, str]] = []
    for index, (agent, satellite) in enumerate(satellites.items()):
        rule = flight_of(parameters, agent, satellite)
        interface = interface_of(rule)
        if rule is None or interface is None:
            continue
        number = next((n for n, each in enumerate(rules) if each is rule), 0)
        place = f"[{number}]" if isinstance(parameters.flight, tuple) else ""
        values = {"name": agent, "index": str(index), "satellite": satellite}
        taken = _taken(interface, values, base_directory)
        if taken is not None:
            key, kind, what = taken
            fields.append(
                (agent, f"parameters.flight{place}.interface.transport.{key}", kind, what)
            )
    # Who listens at all of a machine's addresses is in the way of whoever listens at one of them.
    everywhere = {
        (kind, _port(what))
        for _, _, kind, what in fields
        if kind in _PORTS and _host(what) in ANY_HOST
    }
    for agent, field, kind, what in fields:
        is_everywhere = kind in _PORTS and (kind, _port(what)) in everywhere
        place = f"{kind} {_port(what) if is_everywhere else what}"
        yield PlaceUse(agent=agent, field=field, place=place)


_PORTS = ("TCP port", "UDP port")


def _taken(
    interface: FlightInterface, values: dict[str, str], base_directory: Path
) -> tuple[str, str, str] | None:
    """Return the transport's field, what kind of place it names, and which; None if others may have it, too."""
    transport = interface.transport
    match transport:
        case SerialTransport():
            return "port", "serial port", substitute(transport.port, values)
        case TcpTransport():
            address = _plain(substitute(transport.address, values))
            is_taken = transport.listen and _port(address) != "0"
            return ("address", "TCP port", address) if is_taken else None
        case UdpTransport():
            address = _plain(substitute(transport.local, values))
            return ("local", "UDP port", address) if _port(address) != "0" else None
        case UnixTransport():
            path = str(Path(base_directory) / substitute(transport.path, values))
            return ("path", "socket", path) if transport.listen else None
        case StdioTransport() | PtyTransport() | DeviceTransport():
            return None
        case _:
            assert_never(transport)


def _plain(address: str) -> str:
    """Return an address in one form: no brackets, no leading zeros, localhost as a number."""
    host, port = _host(address), _port(address)
    host = "127.0.0.1" if host == "localhost" else host
    try:
        host = str(ipaddress.ip_address(host))
    except ValueError:
        host = host.lower()
    return f"{host}:{port.lstrip('0') or '0'}"


def _host(address: str) -> str:
    return address.rpartition(":")[0].strip("[]")


def _port(address: str) -> str:
    return address.rpartition(":")[2]
