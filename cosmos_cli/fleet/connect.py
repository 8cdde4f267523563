"""The one way to a machine: over SSH, or to this computer."""

from __future__ import annotations

from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.opening import open_ssh
from cosmos_cli.fleet.target import Target

__all__ = ["ConnectOptions", "connect"]

DEFAULT = ConnectOptions()


def connect(target: Target, options: ConnectOptions = DEFAULT) -> Connection:
    """
    Connect to a machine; who calls closes the connection.

    Raises:
        MachineFailure: In words that say what to do.
        InputError: The operator's ssh configuration cannot be read.
    """
    if target.connection == "local":
        return LocalConnection(target)
    return open_ssh(target, options)
