"""`cosmos up`: from bare machines to ready ones; what is ready already is left alone."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    Fleet,
    ForksOption,
    InventoryOption,
    LimitOption,
    fleet_of,
    warn_of_same,
)
from cosmos_cli.errors import ExitCode
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.fleet.pool import BackgroundCall
from cosmos_cli.fleet.retry_file import offer_retry
from cosmos_cli.fleet.target import machines_of
from cosmos_cli.provision import HELPER_PARTS, up_table
from cosmos_cli.provision.udp_echo import Echo
from cosmos_cli.provision.up_table import MachineResult, result_of
from cosmos_cli.provision.up_view import UpView
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui.console import WORK_GOES_ON, Console, JsonOption, QuietOption
from cosmos_cli.ui.step_times import HERE, timed

if TYPE_CHECKING:
    from cosmos_cli.fleet.connection import Connection
    from cosmos_cli.provision.up import FleetUp


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
    console = Console(json=json, quiet=quiet, instead=WORK_GOES_ON)
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
    warn_of_same(console, fleet)
    names = [target.name for target in fleet.targets]

    def gather() -> FleetUp:
        # Imported here: while logging in, as what it needs takes as long.
        with IMPORT_TURN:
            from cosmos_cli.provision.up import FleetUp, UpOptions

        options = UpOptions(is_check=check, has_texts=diff, host=host)
        with timed(HERE, "read the inventory and the scenarios"):
            found = FleetUp(fleet, scenarios or (), options, echo=echo, view=view)
            _look_at_devices(found, fleet, inventory if limit else None, host=host)
            return found

    with Echo() as echo, UpView(console, names) as view:
        # Logging in takes as long as validating the inventory and reading scenarios: both go on at once.
        fleet_up = BackgroundCall(gather)
        outcomes = fleet.each_target(
            lambda connection: _bring(connection, fleet_up),
            lambda outcome: view.done(outcome.machine, result_of(outcome).words(is_check=check)),
            view.look,
        )
        fleet_up.result()  # tells faults of what was read here, also where no machine could be asked
    results = [result_of(outcome) for outcome in outcomes]
    _show(console, results, is_check=check, has_diffs=diff)
    retry = offer_retry(
        console,
        fleet.sources,
        failed=[result.machine for result in results if result.status == "failed"],
        count=len(results),
        needed=host,
    )
    return _end(console, results, retry, is_check=check, duration_s=time.monotonic() - start_s)


def _look_at_devices(
    fleet_up: FleetUp, fleet: Fleet, whole: list[str] | None, *, host: str | None
) -> None:
    """Tell what is wrong with the scenarios' devices; *whole* names the inventory of which the fleet is a part."""
    if not fleet_up.scenarios:
        return
    # Imported here, as above: not needed for the runtime alone.
    with IMPORT_TURN:
        from cosmos_cli.launch.device_plan import look_at_devices

    machines = fleet.machines if whole is None else machines_of(whole)
    for scenario in fleet_up.scenarios:
        look_at_devices(scenario, machines, host=host, warn=fleet_up.warn)


def _bring(connection: Connection, fleet_up: BackgroundCall[FleetUp]) -> MachineResult | None:
    if connection.target.connection == "local":
        return None
    with Helper.start(connection, HELPER_PARTS, watch=SilenceWatch(connection)) as board:
        return fleet_up.result().bring(connection, board)


def _show(
    console: Console, results: list[MachineResult], *, is_check: bool, has_diffs: bool
) -> None:
    if is_check or has_diffs:
        for line in up_table.plan_lines(results, has_diffs=has_diffs):
            console.data(line)
    console.table(up_table.COLUMNS, [result.row(is_check=is_check) for result in results])
    for line in up_table.note_lines(results):
        console.say(f"note: {line}")


def _end(
    console: Console,
    results: list[MachineResult],
    retry: dict[str, Any] | None,
    *,
    is_check: bool,
    duration_s: float,
) -> int:
    console.data(up_table.verdict(results, is_check=is_check, duration_s=duration_s))
    is_failed = any(result.status == "failed" for result in results)
    exit_code = int(ExitCode.MACHINES if is_failed else ExitCode.OK)
    console.print_json(
        {**up_table.document(results, is_check=is_check), "retry": retry, "exit_code": exit_code}
    )
    return exit_code
