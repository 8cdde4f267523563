"""
Faults in the addresses of a transport: what is no address, and what cannot be one for some vehicle.

As in `check_flight`, which asks here.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, assert_never

from madns_runtime.simulations.constellation.interface_settings import (
    SOCKET_PATH_BYTES_MAX,
    AnyTransport,
    DeviceTransport,
    PtyTransport,
    SerialTransport,
    StdioTransport,
    TcpTransport,
    UdpTransport,
    UnixTransport,
)
from madns_runtime.simulations.constellation.substitution import (
    NAMES,
    substitute,
    substitution_faults,
)

ADDRESS: Final = re.compile(r".+:(\d{1,5})")
PORT_MAX: Final = 65_535
NO_VALUES: Final[Mapping[str, str]] = {}


def address_faults(
    field: str,
    transport: AnyTransport,
    vehicles: Sequence[Mapping[str, str]],
    base_directory: Path,
) -> Iterator[str]:
    """
    Yield the faults.

    Args:
        field: Dotted name of the transport.
        transport: As it was written.
        vehicles: What stands for ${name} and the others in each vehicle that has it; empty if that is not known.
        base_directory: Folder of the scenario.
    """
    for name, address in _addresses(transport):
        faults = list(substitution_faults(f"{field}.{name}", address, NAMES))
        yield from faults
        if not faults:
            yield from _first(
                _faults(f"{field}.{name}", transport, substitute(address, values), base_directory)
                for values in _known(address, vehicles)
            )
    if isinstance(transport, UdpTransport) and transport.remote is not None:
        both = f"{transport.local} {transport.remote}"
        yield from _first(
            _families(
                f"{field}.remote",
                substitute(transport.local, values),
                substitute(transport.remote, values),
            )
            for values in _known(both, vehicles)
        )


def _known(text: str, vehicles: Sequence[Mapping[str, str]]) -> Sequence[Mapping[str, str]]:
    """Return the vehicles in which a text says something else; one that stands for all if it is the same in each."""
    return vehicles if "${" in text else (NO_VALUES,)


def _first(faults: Iterator[Iterator[str]]) -> Iterator[str]:
    """Yield the faults of the first vehicle that has any: the others' are alike."""
    for one in faults:
        if found := list(one):
            yield from found
            return


def _addresses(transport: AnyTransport) -> Iterator[tuple[str, str]]:
    """Yield names and values of a transport's addresses."""
    match transport:
        case TcpTransport():
            yield "address", transport.address
        case UdpTransport():
            yield "local", transport.local
            if transport.remote is not None:
                yield "remote", transport.remote
        case UnixTransport():
            yield "path", transport.path
        case SerialTransport():
            yield "port", transport.port
        case DeviceTransport():
            yield "device", transport.device
        case StdioTransport() | PtyTransport():
            pass
        case _:
            assert_never(transport)


def _faults(
    field: str, transport: AnyTransport, address: str, base_directory: Path
) -> Iterator[str]:
    if isinstance(transport, UnixTransport):
        path = str(base_directory.absolute() / address)
        size = len(os.fsencode(path))
        if size > SOCKET_PATH_BYTES_MAX:
            yield (
                f"{field}: expected a path of at most {SOCKET_PATH_BYTES_MAX} bytes, which is all that a socket's may have, "
                f"got {size}: {path}; an absolute one such as /tmp/NAME is shorter"
            )
    elif isinstance(transport, TcpTransport | UdpTransport):
        yield from _port_faults(field, transport, address)


def _port_faults(field: str, transport: TcpTransport | UdpTransport, address: str) -> Iterator[str]:
    found = ADDRESS.fullmatch(address)
    if found is None:
        yield f"{field}: expected HOST:PORT, got {address!r}"
        return
    if int(found[1]) > PORT_MAX:
        yield f"{field}: expected a port of at most {PORT_MAX}, got {address!r}"
        return
    is_ours = transport.listen if isinstance(transport, TcpTransport) else field.endswith("local")
    if int(found[1]) == 0 and not is_ours:
        yield f"{field}: expected the port that the software listens at, got 0; a free one is for the agent's own address"


def _families(field: str, local: str, remote: str) -> Iterator[str]:
    """Yield a fault if one address is of IPv4 and the other of IPv6; names of hosts may be either."""
    ours, theirs = _version(local), _version(remote)
    if None not in (ours, theirs) and ours != theirs:
        yield (
            f"{field}: expected an address of IPv{ours} as local, {local}, is, got {remote} of IPv{theirs}; "
            "give both of one kind"
        )


def _version(address: str) -> int | None:
    try:
        return ipaddress.ip_address(address.rpartition(":")[0].strip("[]")).version
    except ValueError:
        return None
