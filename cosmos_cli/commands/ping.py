"""`cosmos ping`: which machines answer, and how quickly."""

from __future__ import annotations

import time
from typing import Any

from cosmos_cli.commands.fleet_options import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    Fleet,
    ForksOption,
    InventoryOption,
    LimitOption,
    fleet_of,
)
from cosmos_cli.console import Console, JsonOption, QuietOption
from cosmos_cli.counted import counted
from cosmos_cli.errors import ExitCode
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.ordered import InOrder
from cosmos_cli.fleet.outcome import Outcome, failed

COMMAND_TIMEOUT_S = 10.0

Times = tuple[float, float]
"""Milliseconds to be logged in, and of a command there and back."""


def ping(
    inventory: InventoryOption,
    limit: LimitOption = None,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Log in at every machine, run nothing of note there, and say how long both took.

    Ends with 3 when any machine failed; its line says why and what to do.
    """
    console = Console(json=json, quiet=quiet)
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
    addresses = {target.name: target.address for target in fleet.targets}
    widths = max(map(len, addresses)), max(map(len, addresses.values()))

    def tell(outcome: Outcome[Times]) -> None:
        head = f"{outcome.machine:<{widths[0]}}  {addresses[outcome.machine]:<{widths[1]}}"
        console.data(f"{head}  {_words(outcome)}")

    outcomes = fleet.each_target(_ask, InOrder(fleet.targets, tell))
    bad = failed(outcomes)
    exit_code = ExitCode.MACHINES if bad else ExitCode.OK
    console.data(_verdict(len(outcomes), len(bad)))
    console.print_json(
        {
            "machines": [
                outcome.to_mapping(_mapping(fleet, index, outcome.value))
                for index, outcome in enumerate(outcomes)
            ],
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


def _ask(connection: Connection) -> Times:
    start_s = time.monotonic()
    connection.run("true", timeout_s=COMMAND_TIMEOUT_S)
    return connection.opening_s * 1e3, (time.monotonic() - start_s) * 1e3


def _words(outcome: Outcome[Times]) -> str:
    if outcome.value is None:
        return f"failed  {outcome.failure}"
    ssh_ms, exec_ms = outcome.value
    return f"ok      ssh {ssh_ms:6.1f} ms  exec {exec_ms:6.1f} ms"


def _mapping(fleet: Fleet, index: int, times: Times | None) -> dict[str, Any]:
    ssh_ms, exec_ms = times or (None, None)
    return {
        "address": fleet.targets[index].address,
        "ssh_ms": None if ssh_ms is None else round(ssh_ms, 2),
        "exec_ms": None if exec_ms is None else round(exec_ms, 2),
    }


def _verdict(count: int, bad: int) -> str:
    machines = counted(count, "machine")
    return (
        f"{machines}: {count - bad} answered, {bad} failed" if bad else f"{machines}: all answered"
    )
