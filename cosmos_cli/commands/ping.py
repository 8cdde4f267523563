"""`cosmos ping`: which machines answer, and how quickly."""

from __future__ import annotations

import time
from typing import Any

from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    InventoryOption,
    LimitOption,
    finish,
    fleet_of,
)
from cosmos_cli.fleet.connection import SMALL_BYTES_MAX, Connection
from cosmos_cli.fleet.failure import runs_no_commands
from cosmos_cli.fleet.outcome import InOrder, Outcome, failed
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.plural import counted

COMMAND_TIMEOUT_S = 10.0
WORD = "cosmos-ping"

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

    in_order = InOrder(fleet.targets, tell)
    outcomes = fleet.each_target(_ask, in_order, in_order.wait)
    return finish(
        console,
        fleet,
        outcomes=outcomes,
        verdict=_verdict(len(outcomes), len(failed(outcomes))),
        document={
            "machines": [o.to_mapping(_mapping(addresses[o.machine], o.value)) for o in outcomes]
        },
    )


def _ask(connection: Connection) -> Times:
    start_s = time.monotonic()
    done = connection.run(
        f"echo {WORD}", timeout_s=COMMAND_TIMEOUT_S, said_bytes_max=SMALL_BYTES_MAX
    )
    exec_s = time.monotonic() - start_s
    if done.exit_status or WORD.encode() not in done.stdout:  # a login shell may be /bin/true
        raise runs_no_commands(
            done.exit_status, (done.stderr or done.stdout).decode(errors="replace")
        )
    return connection.opening_s * 1e3, exec_s * 1e3


def _words(outcome: Outcome[Times]) -> str:
    if outcome.value is None:
        return f"failed  {outcome.failure}"
    ssh_ms, exec_ms = outcome.value
    return f"ok      ssh {ssh_ms:6.1f} ms  exec {exec_ms:6.1f} ms"


def _mapping(address: str, times: Times | None) -> dict[str, Any]:
    ssh_ms, exec_ms = times or (None, None)
    return {
        "address": address,
        "ssh_ms": None if ssh_ms is None else round(ssh_ms, 2),
        "exec_ms": None if exec_ms is None else round(exec_ms, 2),
    }


def _verdict(count: int, bad: int) -> str:
    told = f"{count - bad} answered, {bad} failed" if bad else "all answered"
    return f"{counted(count, 'machine')}: {told}"
