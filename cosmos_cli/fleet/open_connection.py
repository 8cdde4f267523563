"""The one way to a machine, of whatever kind its connection is."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.ssh.connect import open_ssh
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.connection_kind import ConnectionKind
from cosmos_cli.ui.step_times import timed

DEFAULT = ConnectOptions()


def connect(target: Target, options: ConnectOptions = DEFAULT) -> Connection:
    """
    Connect to a machine; who calls closes the connection.

    Raises:
        MachineFailure: In words that say what to do.
        InputError: The operator's ssh configuration cannot be read.
    """
    return OPENERS[target.connection](target, options)


def _connect_ssh(target: Target, options: ConnectOptions) -> Connection:
    with timed(target.name, "connect"):
        return open_ssh(target, options)


OPENERS: Mapping[ConnectionKind, Callable[[Target, ConnectOptions], Connection]] = {
    "local": lambda target, options: LocalConnection(target),
    "ssh": _connect_ssh,
}
"""How each kind of connection is opened."""
