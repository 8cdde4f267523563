"""
From an entry of the inventory to somebody logged in: which way, how often, how long.

Opening is tried again, within its deadline, when the machine refused the connection or closed it before a
word was said, as one does that is just starting; a refused login never is.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.ssh_failures import opening_failure
from cosmos_cli.fleet.ssh_settings import JUMPS_MAX, SshSettings, settings_of
from cosmos_cli.fleet.target import Target
from cosmos_cli.fleet.wire import Wire, connect_tcp, connect_through_command

if TYPE_CHECKING:
    from cosmos_cli.fleet.ssh import SshConnection

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
        importing_s = time.monotonic()
        # Here, when the servers of the first machines have begun to start: see `ssh`.
        from cosmos_cli.fleet.ssh import SshConnection, log_in

        importing_s -= time.monotonic()  # negative: not the machine's time
        connection = SshConnection(target, log_in(settings, options, wire, until_s), wire, hops)
        connection.opening_s = importing_s
        opened.pop_all()
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
            text = f"jump host {jump.address}: {failure.text}"
            raise MachineFailure(failure.kind, text, failure.advice) from failure
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
    from cosmos_cli.fleet.ssh import SshConnection, log_in

    return SshConnection(jump, log_in(settings, options, wire, until_s), wire)


def _wire(settings: SshSettings, hops: Sequence[SshConnection], timeout_s: float) -> Wire:
    if hops:
        return hops[-1].wire_to(settings.host, settings.port, timeout_s=timeout_s)
    try:
        if settings.proxy_command:
            return connect_through_command(settings.proxy_command)
        return connect_tcp(settings.host, settings.port, timeout_s=timeout_s)
    except OSError as error:
        raise opening_failure(error, settings.where, timeout_s) from error
