"""`cosmos facts`: what each machine is like, as provisioning finds it."""

from __future__ import annotations

from datetime import UTC, datetime

from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    InventoryOption,
    LimitOption,
    finish,
    fleet_of,
)
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.ui.console import Column, Console, JsonOption, QuietOption
from cosmos_cli.ui.plural import counted

PARTS = ("files", "links", "dpkg", "facts")
TIMEOUT_S = 60.0
GIB = 1024**3
COLUMNS = (
    Column("machine"),
    Column("model"),
    Column("arch"),
    Column("system"),
    Column("python"),
    Column("cpus", is_number=True),
    Column("memory GiB", is_number=True),
    Column("disk free", is_number=True),
    Column("clock s", is_number=True),
    Column("settings"),
)


def facts(
    inventory: InventoryOption,
    limit: LimitOption = None,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Show what each machine is like: model, system, Python, memory, disk, clock, settings. Changes nothing.

    Ends with 3 when any machine failed; the others are shown all the same.
    """
    console = Console(json=json, quiet=quiet)
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)

    def tell(outcome: Outcome[MachineFacts]) -> None:
        if not outcome.is_ok:  # at once; the others' answers are shown side by side
            console.data(f"{outcome.machine}  failed  {outcome.failure}")

    outcomes = fleet.each_target(_ask, tell)
    rows = [_row(outcome.machine, outcome.value) for outcome in outcomes if outcome.value]
    if rows:
        console.table(COLUMNS, rows)
    bad = len(outcomes) - len(rows)
    told = f", {bad} failed" if bad else ""
    return finish(
        console,
        fleet,
        outcomes=outcomes,
        verdict=f"{counted(len(outcomes), 'machine')}: {len(rows)} answered{told}",
        document={
            "machines": [
                outcome.to_mapping({"facts": outcome.value and outcome.value.to_mapping()})
                for outcome in outcomes
            ]
        },
    )


def _ask(connection: Connection) -> MachineFacts:
    arguments = {"root": connection.target.root, "sudo": connection.target.may_become_root}
    with Helper.start(connection, PARTS, watch=SilenceWatch(connection)) as board:
        asked = datetime.now(UTC)
        told = board.call("facts", arguments, timeout_s=TIMEOUT_S).value
        return MachineFacts.from_mapping(
            told,
            asked_utc_s=asked.timestamp(),
            answered_utc_s=datetime.now(UTC).timestamp(),
        )


def _row(machine: str, told: MachineFacts) -> tuple[str, ...]:
    board, memory_bytes = told.board, told.memory_total_bytes
    return (
        machine,
        board.model or "",
        board.machine if board.bits == 64 else f"{board.machine} ({board.bits} bit)",
        board.os_name,
        ".".join(map(str, told.python.version)),
        "" if board.processors is None else str(board.processors),
        "" if memory_bytes is None else f"{memory_bytes / GIB:.1f}",
        f"{told.disk.free_bytes / GIB:.1f} of {told.disk.total_bytes / GIB:.1f}",
        f"{told.clock_offset_s:+.3f}",
        ", ".join(_settings(told)),
    )


def _settings(told: MachineFacts) -> list[str]:
    """Return what provisioning can set, as it is now."""
    buffer_bytes = told.network.receive_buffer_bytes_max
    priority = told.realtime_priority_max
    words = [f"buffer {buffer_bytes}"] if buffer_bytes is not None else []
    words += ["PREEMPT_RT"] if told.board.is_preempt_rt else []
    words.append(f"priority {'any' if priority is None else priority}")
    words += sorted(set(told.governors.values()))
    words += [f"{r.type} off" for r in told.radios if r.is_soft_blocked or r.is_hard_blocked]
    if told.can_become_root is not None:
        words.append("sudo" if told.can_become_root else "no sudo")
    return words
