"""
From an entry of the inventory to somebody logged in: which way, how often, how long.

Opening is tried again, within its deadline, when the machine refused the connection or closed it before a
word was said, as one does that is just starting; a refused login never is.

Each library is imported when the machines have something to do meanwhile: paramiko while their servers start,
Fabric, which takes twice as long, while both sides agree on keys. Connecting even before the command line is
read would save `exec` on 24 boards 39 ms more, 1.7 % (median of 40 interleaved pairs on two busy cores), for a
second reader of its options.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.ssh.failures import opening_failure
from cosmos_cli.fleet.ssh.known_hosts import KnownHosts
from cosmos_cli.fleet.ssh.link_local import address_as_seen
from cosmos_cli.fleet.ssh.settings import JUMPS_MAX, SshSettings, settings_of
from cosmos_cli.fleet.ssh.socket import SshSocket, connect_tcp, connect_through_command
from cosmos_cli.fleet.target import Target
from cosmos_cli.system.import_turn import IMPORT_TURN

if TYPE_CHECKING:
    # As above: the machine answers while this is imported.
    from cosmos_cli.fleet.ssh.connection import SshConnection

PAUSES_S = (0.2, 0.5, 1.0)
"""Before the second and each further attempt."""
TIMEOUT_S_MIN = 0.1


def open_ssh(
    target: Target, options: ConnectOptions, *, trail: tuple[str, ...] = ()
) -> SshConnection:
    """
    Log in at a machine.

    Args:
        target: The machine.
        options: How long, and whether unknown host keys are recorded.
        trail: Addresses of the machines whose way leads through this one.

    Raises:
        MachineFailure: In words that say what to do.
        InputError: The ssh configuration cannot be read.
    """
    settings = settings_of(target)
    timeout_s = settings.connect_timeout_s or options.timeout_s
    start_s = time.monotonic()
    until_s = start_s + timeout_s
    pauses_s = iter(PAUSES_S)
    while True:
        try:
            connection = _open_once(target, settings, options, until_s=until_s, trail=trail)
            connection.opening_s += time.monotonic() - start_s
            return connection
        except MachineFailure as failure:
            pause_s = next(pauses_s, timeout_s)
            is_over = time.monotonic() + pause_s >= until_s
            if failure.kind is not FailureKind.REFUSED or is_over:
                raise
        time.sleep(pause_s)


def _open_once(
    target: Target,
    settings: SshSettings,
    options: ConnectOptions,
    *,
    until_s: float,
    trail: tuple[str, ...],
) -> SshConnection:
    with contextlib.ExitStack() as opened:
        hops = _hops(settings, options, trail, opened)
        wire = _wire(settings, hops, max(TIMEOUT_S_MIN, until_s - time.monotonic()))
        connection = _logged_in(target, settings, options, wire=wire, until_s=until_s)
        connection.hops = hops
        if not hops:
            wire.own_address = address_as_seen(wire.own_address, connection.run)
        opened.pop_all()
        return connection


def _logged_in(
    target: Target,
    settings: SshSettings,
    options: ConnectOptions,
    *,
    wire: SshSocket,
    until_s: float,
) -> SshConnection:
    """Log in over an open wire; the time of imports is not the machine's."""
    known = KnownHosts(settings.known_hosts)
    start_s = time.monotonic()
    # Imported here, and in this order, for the reason that the module's docstring gives.
    with IMPORT_TURN:
        from cosmos_cli.fleet.ssh.transport import make_transport

    names = settings.names
    transport = make_transport(wire, known.kinds(names), is_certified=known.has_authority(names))
    transport.begin(timeout_s=max(TIMEOUT_S_MIN, until_s - time.monotonic()))
    with IMPORT_TURN:
        from cosmos_cli.fleet.ssh.connection import SshConnection, log_in  # as above

    importing_s = time.monotonic() - start_s
    connection = SshConnection(target, log_in(settings, options, transport, until_s))
    connection.opening_s = -importing_s
    return connection


def _hops(
    settings: SshSettings,
    options: ConnectOptions,
    trail: tuple[str, ...],
    opened: contextlib.ExitStack,
) -> list[SshConnection]:
    """Connect to the jump hosts, the nearest first, each through those before it."""
    hops: list[SshConnection] = []
    for jump in settings.jumps if len(trail) < JUMPS_MAX else ():
        if jump.address in (settings.host, *trail):
            continue  # `Host *` with a ProxyJump means the jump host itself as well
        try:
            hop = _open_hop(jump, options, (*trail, settings.host, jump.address), hops)
        except MachineFailure as failure:
            raise MachineFailure(
                failure.kind, f"jump host {jump.address}: {failure.text}", failure.advice
            ) from failure
        opened.callback(hop.close)
        hops.append(hop)
    return hops


def _open_hop(
    jump: Target, options: ConnectOptions, trail: tuple[str, ...], before: Sequence[SshConnection]
) -> SshConnection:
    if not before:
        return open_ssh(jump, options, trail=trail)
    settings = settings_of(jump)
    until_s = time.monotonic() + options.timeout_s
    wire = before[-1].wire_to(settings.host, settings.port, timeout_s=options.timeout_s)
    return _logged_in(jump, settings, options, wire=wire, until_s=until_s)


def _wire(settings: SshSettings, hops: Sequence[SshConnection], timeout_s: float) -> SshSocket:
    if hops:
        return hops[-1].wire_to(settings.host, settings.port, timeout_s=timeout_s)
    try:
        if settings.proxy_command:
            return connect_through_command(settings.proxy_command)
        return connect_tcp(settings.host, settings.port, timeout_s=timeout_s)
    except OSError as error:
        raise opening_failure(error, settings.where, timeout_s) from error
