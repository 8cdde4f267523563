"""The one way to a machine, of whatever kind its connection is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.ssh.connect import open_ssh
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.connection_kind import ConnectionKind
from cosmos_cli.ui.step_times import timed

DEFAULT = ConnectOptions()


def connect(target: Target, options: ConnectOptions = DEFAULT) -> Connection:
    """
    Connect to a machine; who calls closes the connection.

    One that is not reached, as its address is another since the run began, is reached where `options.listed` has it.

    Raises:
        MachineFailure: In words that say what to do.
        InputError: The operator's ssh configuration cannot be read.
    """
    moved = _moved(target, options.listed.get(target.name))
    try:
        return OPENERS[target.connection](target, options)
    except MachineFailure as failure:
        if moved is None:
            raise
        first = failure
    try:
        return OPENERS[moved.connection](moved, options)
    except MachineFailure as failure:
        text = f"{first.text}; and where the inventory has it, {failure.text}"
        raise MachineFailure(failure.kind, text, failure.advice) from failure


def _moved(target: Target, listed: Target | None) -> Target | None:
    """Return how an inventory reaches a machine, if that is another way; its folder there is still that of *target*."""
    if listed is None or listed.connection == "local":
        return None
    moved = dataclasses.replace(listed, root=target.root)
    return None if moved == target else moved


def _connect_ssh(target: Target, options: ConnectOptions) -> Connection:
    with timed(target.name, "connect"):
        return open_ssh(target, options)


OPENERS: Mapping[ConnectionKind, Callable[[Target, ConnectOptions], Connection]] = {
    "local": lambda target, options: LocalConnection(target),
    "ssh": _connect_ssh,
}
"""How each kind of connection is opened."""
