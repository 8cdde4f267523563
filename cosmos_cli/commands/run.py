"""`cosmos run`: launch a scenario, watch it, shut it down, collect and judge it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.fleet_options import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    HostOption,
    LimitOption,
    SomeInventoryOption,
    some_machines,
)
from cosmos_cli.console import Console, JsonOption, QuietOption, SetOption, losing_output
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.launch.execute import Detached, RunOptions, execute
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.rundir import runs_root
from cosmos_cli.view.factory import make_view


def run(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO", help="Scenario file.")],
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    host: HostOption = None,
    detach: Annotated[
        bool, typer.Option("--detach", help="Leave the run to itself once it is under way.")
    ] = False,
    set_: SetOption = None,
    duration_s: Annotated[
        float | None,
        typer.Option(
            "--duration", metavar="S", help="Simulated time, s; as --set time.duration_s."
        ),
    ] = None,
    runs: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", envvar="COSMOS_RUNS", help="Folder of all runs; default: ./runs."
        ),
    ] = None,
    manual: Annotated[
        list[str] | None,
        typer.Option(metavar="AGENT", help="Print the command that starts this agent by hand."),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write report.html at the end.")
    ] = True,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run a scenario, in real time or lockstep, here or on the machines of an inventory, and end with a verdict."""
    console = Console(json=json, quiet=quiet)
    overrides = list(set_ or ())
    if duration_s is not None:
        overrides.append(f"time.duration_s={duration_s!r}")
    options = RunOptions(
        runs=runs_root(runs),
        manual=tuple(dict.fromkeys(manual or ())),
        has_report=report,
        machines=some_machines(inventory, limit, host),
        host=host,
        is_detached=detach,
        forks=forks,
        connecting=ConnectOptions(accept_new_host_keys=accept_new_host_keys),
    )
    checked = load_scenario(scenario, overrides)
    summary = execute(checked, options, partial(make_view, quiet=quiet), console.say)
    if isinstance(summary, Detached):
        console.print_json(summary.to_mapping())
        (console.say if json else console.data)(summary.words)
        return
    with losing_output(f"{summary.verdict.text}; it stands in {summary.run.run_json}"):
        console.print_json(dict(summary.document))
        (console.say if json else console.data)(summary.last_line)
    raise typer.Exit(int(summary.exit_code))
