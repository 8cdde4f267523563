"""`cosmos up`: from bare machines to ready ones; what is ready already is left alone."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision import up_table
from cosmos_cli.provision.bring_up import Brought, UpOptions, bring_up
from cosmos_cli.provision.echo import Echo
from cosmos_cli.provision.kit import Workshop
from cosmos_cli.provision.up_table import MachineResult
from cosmos_cli.provision.up_view import UpView

if TYPE_CHECKING:
    from cosmos_cli.models.loading import ScenarioFile


def up(
    inventory: InventoryOption,
    scenarios: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[SCENARIO]...", help="Scenarios to be run there; else the runtime alone."
        ),
    ] = None,
    limit: LimitOption = None,
    forks: ForksOption = FORKS_DEFAULT,
    host: Annotated[
        str | None,
        typer.Option(metavar="MACHINE", help="The machine that will run the host, as run --host."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Show what would change, and change nothing.")
    ] = False,
    diff: Annotated[
        bool, typer.Option("--diff", help="Show how contents of files change.")
    ] = False,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Make machines ready: packages, settings, Python environment, code, and whatever their groups declare.

    The second time nothing changes. Ends with 3 when any machine failed; the others are ready all the same.
    """
    start_s = time.monotonic()
    console = Console(json=json, quiet=quiet)
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
    if host is not None and host not in {machine.name for machine in fleet.machines}:
        raise InputError(f"--host {host}: there is no such machine among those to be made ready")
    files = _load(scenarios or ())
    options = UpOptions(is_check=check, has_texts=diff)
    with Echo() as echo, UpView(console, [m.name for m in fleet.machines]) as view:
        kit = Workshop(files, host=host, echo=echo, options=fleet.options)
        results = _bring_all(fleet, kit, options, view)
    _show(console, results, options)
    duration_s = time.monotonic() - start_s
    console.data(up_table.verdict(results, is_check=check, duration_s=duration_s))
    is_failed = any(result.status == "failed" for result in results)
    exit_code = ExitCode.MACHINES if is_failed else ExitCode.OK
    console.print_json({**up_table.document(results, is_check=check), "exit_code": int(exit_code)})
    return int(exit_code)


def _load(paths: Sequence[Path]) -> list[ScenarioFile]:
    if not paths:
        return []
    from cosmos_cli.models.loading import load_scenario  # not needed for the runtime alone

    return [load_scenario(path) for path in paths]


def _bring_all(
    fleet: Fleet, kit: Workshop, options: UpOptions, view: UpView
) -> list[MachineResult]:
    def work(connection: Connection, machine: Machine) -> Brought:
        if connection.target.connection == "local":
            return Brought(is_local=True)
        return bring_up(connection, machine, kit, options, view.teller(machine.name))

    def done(outcome: Outcome[Brought]) -> None:
        result = _result(outcome)
        view.done(outcome.machine, result.row(is_check=options.is_check)[-1])

    return [_result(outcome) for outcome in fleet.each(work, done)]


def _result(outcome: Outcome[Brought]) -> MachineResult:
    brought = outcome.value or Brought(failure=outcome.failure)
    return MachineResult(machine=outcome.machine, brought=brought, duration_s=outcome.duration_s)


def _show(console: Console, results: list[MachineResult], options: UpOptions) -> None:
    if options.is_check or options.has_texts:
        for line in up_table.plan_lines(results, has_diffs=options.has_texts):
            console.data(line)
    rows = [result.row(is_check=options.is_check) for result in results]
    console.table(up_table.COLUMNS, rows)
    for line in up_table.note_lines(results):
        console.say(f"note: {line}")
