"""`cosmos wipe`: deletes old runs on machines, those that were collected; or all of COSMoS there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Any

import typer

from cosmos_cli.collect.wipe import Order, RunThere, Wiped, carry_out, look, make_order, runs_here
from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    Fleet,
    ForksOption,
    InventoryOption,
    LimitOption,
    fleet_of,
)
from cosmos_cli.commands.run_arguments import RunsOption
from cosmos_cli.errors import ExitCode
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.outcome import Outcome, failure_teller
from cosmos_cli.fleet.retry_file import offer_retry
from cosmos_cli.ui.console import Column, Console, JsonOption, QuietOption, confirm
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.sizes import size_words

COLUMNS = (
    Column("machine"),
    Column("run"),
    Column("files", is_number=True),
    Column("size", is_number=True),
    Column("changed (UTC)"),
    Column("state"),
    Column("will be"),
)
INSTALLED = "environments, trees, wheels"
HOLDER = "cosmos wipe"


def wipe(
    inventory: InventoryOption,
    limit: LimitOption = None,
    uncollected: Annotated[
        bool, typer.Option("--uncollected", help="Delete also runs that were never collected.")
    ] = False,
    all_: Annotated[
        bool,
        typer.Option(
            "--all", help="Delete environments and code as well: all that `up` put there."
        ),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    folder: RunsOption = None,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Delete what runs left on machines. What was not collected stays, and so does what lives.

    Shows what would go and asks. A run counts as collected when all that lies there is here, verified
    once more. Ends with 3 when any machine failed.
    """
    console = Console(json=json, quiet=quiet)
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
    known = runs_here(runs_root(folder))

    def find(connection: Connection) -> Order:
        if connection.target.connection == "local":
            return Order()  # runs on this computer record where they are collected
        findings = look(connection, known, is_all=all_)
        return make_order(findings, is_all=all_, with_uncollected=uncollected)

    found = fleet.each_target(find, failure_teller(console.say))
    rows = [row for outcome in found for row in _rows(outcome)]
    if rows:
        console.table(COLUMNS, rows)
    orders = {o.machine: o.value for o in found if o.value and not o.value.is_empty}
    if orders and not confirm(_question(list(orders.values())), is_sure=yes):
        console.say("nothing was deleted")
        orders = {}
    gone: dict[str, list[RunThere]] = {machine: [] for machine in orders}
    wiped = _carry_out(console, fleet, orders, gone)
    # Only now: a table that nobody sees asks nobody, and nothing is deleted.
    told = dataclasses.replace(console, instead="the exit code tells whether a machine failed")
    return _tell(told, fleet, found, {name: _with_gone(o, gone[name]) for name, o in wiped.items()})


def _with_gone(outcome: Outcome[Wiped], gone: Sequence[RunThere]) -> Outcome[Wiped]:
    """Return an outcome that has an account of what was deleted before a failure as well."""
    if outcome.value is not None:
        return outcome
    names, size = tuple(run.name for run in gone), sum(run.bytes for run in gone)
    return dataclasses.replace(outcome, value=Wiped(runs=names, bytes=size))


def _carry_out(
    console: Console, fleet: Fleet, orders: dict[str, Order], gone: dict[str, list[RunThere]]
) -> dict[str, Outcome[Wiped]]:
    chosen = dataclasses.replace(
        fleet, targets=tuple(target for target in fleet.targets if target.name in orders)
    )

    def work(connection: Connection) -> Wiped:
        name = connection.target.name
        return carry_out(connection, orders[name], HOLDER, gone[name].append)

    outcomes = chosen.each_target(work, failure_teller(console.say))
    return {outcome.machine: outcome for outcome in outcomes}


def _rows(outcome: Outcome[Order]) -> list[list[str]]:
    order = outcome.value
    if order is None:
        return []
    rows = [_row(outcome.machine, run, "deleted") for run in order.runs]
    rows += [_row(outcome.machine, run, "kept") for run in order.kept]
    if order.is_root:
        rows.append(
            [outcome.machine, INSTALLED, "", size_words(order.installed_bytes), "", "", "deleted"]
        )
    return rows


def _row(machine: str, run: RunThere, fate: str) -> list[str]:
    changed = datetime.fromtimestamp(run.newest_s, UTC).strftime("%Y-%m-%d %H:%M")
    state = f"running: {', '.join(run.living)}" if run.living else run.state
    return [machine, run.name, str(run.files), size_words(run.bytes), changed, state, fate]


def _question(orders: Sequence[Order]) -> str:
    runs = [run for order in orders for run in order.runs]
    lost = sum(run.state == "not collected" for run in runs)
    parts = [counted(len(runs), "run")] if runs else []
    if any(order.is_root for order in orders):
        parts.append(INSTALLED)
    never = f", {lost} of them NEVER COLLECTED" if lost else ""
    size = size_words(sum(order.bytes for order in orders))
    machines = counted(len(orders), "machine")
    return f"delete {' and '.join(parts)} ({size}{never}) on {machines}?"


def _tell(
    console: Console,
    fleet: Fleet,
    found: Sequence[Outcome[Order]],
    wiped: dict[str, Outcome[Wiped]],
) -> int:
    """Say what became of each machine, and return the exit code."""
    failures = {o.machine: o.failure for o in found if o.failure is not None}
    failures |= {o.machine: o.failure for o in wiped.values() if o.failure is not None}
    done = {name: outcome.value for name, outcome in wiped.items() if outcome.value is not None}
    for machine, value in done.items():
        for path in value.left:
            console.say(f"{machine}: kept {path}{_why(path)}")
        if machine in failures and value.runs:
            console.say(f"{machine}: deleted before it failed: {', '.join(value.runs)}")
    runs = counted(sum(len(value.runs) for value in done.values()), "run")
    size = size_words(sum(value.bytes for value in done.values()))
    kept = sum(len(o.value.kept) for o in found if o.value is not None)
    retry = offer_retry(console, fleet.sources, failed=failures, count=len(found))
    console.data(
        f"{counted(len(found), 'machine')}: {runs} deleted ({size}), {kept} kept,"
        f" {len(failures)} failed"
    )
    exit_code = ExitCode.MACHINES if failures else ExitCode.OK
    console.print_json(
        {
            "machines": (
                [_mapping(o, done.get(o.machine), failures.get(o.machine)) for o in found]
            ),
            "retry": retry,
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


def _why(path: str) -> str:
    if path.endswith(".json"):
        return ", which remembers what settings were before; `cosmos up` puts them back"
    return ", which was not collected"


def _mapping(
    found: Outcome[Order], wiped: Wiped | None, failure: MachineFailure | None
) -> dict[str, Any]:
    order = found.value or Order()
    return {
        "machine": found.machine,
        "ok": failure is None,
        "failure": failure.to_mapping() if failure else None,
        "found": [run.to_mapping() for run in (*order.runs, *order.kept)],
        "deleted": list(wiped.runs) if wiped else [],
        "deleted_bytes": wiped.bytes if wiped else 0,
        "is_root_gone": wiped.is_root_gone if wiped else False,
        "left": list(wiped.left) if wiped else [],
    }
