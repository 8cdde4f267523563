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
    lines = _Lines(console, fleet)
    outcomes = fleet.each_target(_ask, lines.take)
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


class _Lines:
    """Prints a line a machine in the inventory's order, each as soon as those above it stand."""

    def __init__(self, console: Console, fleet: Fleet) -> None:
        self._console = console
        self._names = [target.name for target in fleet.targets]
        self._width = max(map(len, self._names))
        self._address_width = max(len(target.address) for target in fleet.targets)
        self._addresses = {target.name: target.address for target in fleet.targets}
        self._done: dict[str, Outcome[Times]] = {}
        self._printed = 0

    def take(self, outcome: Outcome[Times]) -> None:
        self._done[outcome.machine] = outcome
        while self._printed < len(self._names):
            name = self._names[self._printed]
            if name not in self._done:
                return
            self._console.data(self._line(self._done[name]))
            self._printed += 1

    def _line(self, outcome: Outcome[Times]) -> str:
        address = self._addresses[outcome.machine]
        head = f"{outcome.machine:<{self._width}}  {address:<{self._address_width}}"
        if outcome.value is None:
            return f"{head}  failed  {outcome.failure}"
        ssh_ms, exec_ms = outcome.value
        return f"{head}  ok      ssh {ssh_ms:6.1f} ms  exec {exec_ms:6.1f} ms"


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
