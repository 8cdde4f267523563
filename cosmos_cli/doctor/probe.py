"""Asks a machine, or this computer, for everything that is judged: one connection, one request."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from cosmos_cli.doctor.case import Case, Wants
from cosmos_cli.doctor.finding import HERE
from cosmos_cli.doctor.responder import Responder
from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.layout import Layout

PARTS = (
    "files",
    "links",
    "facts",
    "madns_runtime.processes",
    "processes",
    "busy",
    "wakeups",
    "round_trips",
    "interfaces",
    "doctor",
)
WAKE_UP_COUNT = 200
WAKE_UP_HZ = 100.0
ROUND_TRIP_COUNT = 50
TIMEOUT_S = 60.0
"""Some seconds are usual; a disk that has to wait for a worn card may take many."""


def ask(
    connection: Connection,
    wants: Wants,
    responder: Responder,
    *,
    host_address: str | None = None,
) -> dict[str, Any]:
    """
    Return what a machine tells of itself.

    Args:
        connection: To the machine.
        wants: What a run would ask for.
        responder: Answers the machine's datagrams.
        host_address: By which the machine reaches this computer; None for the way of the connection.

    Raises:
        MachineFailure: It cannot be asked.
    """
    layout = Layout(connection.target.root)
    arguments = {
        "wake_ups": _wake_ups(wants, wants.priority),
        "round_trips": {
            "address": host_address or connection.own_address,
            "port": responder.port,
            "nonce_hex": responder.nonce.hex(),
            "count": ROUND_TRIP_COUNT,
        },
        "root": layout.root,
        "runs": layout.runs,
        "environments": layout.environments,
        "state": layout.state,
    }
    return _call(connection, arguments)


def ask_here(
    connection: Connection, wants: Wants, *, runs: str, state: str, interface: str
) -> dict[str, Any]:
    """
    Return what this computer tells of itself, as the machine that a run's host works on.

    Args:
        connection: To this computer.
        wants: What a run would ask for.
        runs: Folder of all runs.
        state: Of the register of processes, COSMOS_STATE_DIR.
        interface: By which the machines are reached.

    Raises:
        MachineFailure: It cannot be asked.
    """
    arguments = {
        "wake_ups": _wake_ups(wants, wants.priority + 1),
        "root": runs,
        "state": state,
        "interface": interface,
    }
    return _call(connection, arguments)


def case_of(machine: str, told: Mapping[str, Any], wants: Wants) -> Case:
    """Return the case that the checks judge."""
    return Case.of(machine, told, wants, is_here=machine == HERE)


def _wake_ups(wants: Wants, priority: int) -> dict[str, Any]:
    return {
        "count": WAKE_UP_COUNT,
        "rate_hz": WAKE_UP_HZ,
        "policy": wants.policy,
        "priority": priority,
    }


def _call(connection: Connection, arguments: Mapping[str, Any]) -> dict[str, Any]:
    with Board.start(connection, PARTS) as board:
        asked_s = time.clock_gettime(time.CLOCK_REALTIME)
        told = dict(board.call("doctor", arguments, timeout_s=TIMEOUT_S).value)
    told["asked_utc_s"] = asked_s
    return told
