"""`cosmos up`: from bare machines to ready ones; what is ready already is left alone."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosmos_cli.background import Background
from cosmos_cli.commands.fleet_options import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    InventoryOption,
    LimitOption,
    fleet_of,
)
from cosmos_cli.console import Console, JsonOption, QuietOption
from cosmos_cli.errors import ExitCode
from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.silence import WatchedConnection
from cosmos_cli.provision.echo import Echo
from cosmos_cli.provision.parts import HELPER_PARTS
from cosmos_cli.provision.up_view import UpView

if TYPE_CHECKING:
    from cosmos_cli.fleet.connection import Connection
    from cosmos_cli.provision.brought import Brought
    from cosmos_cli.provision.fleet_up import FleetUp
    from cosmos_cli.provision.up_table import MachineResult


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
    names = [target.name for target in fleet.targets]

    def gather() -> FleetUp:
        from cosmos_cli.provision.brought import UpOptions
        from cosmos_cli.provision.fleet_up import FleetUp

        options = UpOptions(is_check=check, has_texts=diff, host=host)
        return FleetUp(fleet, scenarios or (), options, echo=echo, view=view)

    with Echo() as echo, UpView(console, names) as view:
        # Logging in takes as long as validating the inventory and reading scenarios: both go on at once.
        fleet_up = Background(gather)
        outcomes = fleet.each_target(
            lambda connection: _bring(connection, fleet_up),
            lambda outcome: view.done(outcome.machine),
        )
        results = [fleet_up.result().result(outcome) for outcome in outcomes]
    _show(console, results, is_check=check, has_diffs=diff)
    return _end(console, results, is_check=check, duration_s=time.monotonic() - start_s)


def _bring(connection: Connection, fleet_up: Background[FleetUp]) -> Brought | None:
    if connection.target.connection == "local":
        return None
    with Board.start(WatchedConnection(connection), HELPER_PARTS) as board:
        return fleet_up.result().bring(connection, board)


def _show(
    console: Console, results: list[MachineResult], *, is_check: bool, has_diffs: bool
) -> None:
    from cosmos_cli.provision import up_table

    if is_check or has_diffs:
        for line in up_table.plan_lines(results, has_diffs=has_diffs):
            console.data(line)
    console.table(up_table.COLUMNS, [result.row(is_check=is_check) for result in results])
    for line in up_table.note_lines(results):
        console.say(f"note: {line}")


def _end(
    console: Console, results: list[MachineResult], *, is_check: bool, duration_s: float
) -> int:
    from cosmos_cli.provision import up_table

    console.data(up_table.verdict(results, is_check=is_check, duration_s=duration_s))
    is_failed = any(result.status == "failed" for result in results)
    exit_code = int(ExitCode.MACHINES if is_failed else ExitCode.OK)
    console.print_json({**up_table.document(results, is_check=is_check), "exit_code": exit_code})
    return exit_code
