"""`cosmos run`: launch a scenario, watch it, shut it down, collect and judge it."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    HostOption,
    LimitOption,
    SomeInventoryOption,
    some_machines,
)
from cosmos_cli.commands.run_arguments import RunsOption
from cosmos_cli.errors import CosmosError, InputError
from cosmos_cli.evidence.run_directory import runs_root, utc_now
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.launch.access import chosen_access
from cosmos_cli.launch.execute import Detached, RunOptions, execute, plan_of
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.models.overrides import told_as_options
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.testing.junit import (
    JunitCase,
    JunitOption,
    junit_case_of,
    prepare_junit,
    write_junit,
)
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, SetOption, losing_output
from cosmos_cli.view.factory import make_view
from madns_runtime.errors import MadnsError


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
    runs: RunsOption = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Say what the run would meet, and change nothing."),
    ] = False,
    manual: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AGENT",
            help="Print the command that starts this agent (or label, or glob) by hand.",
        ),
    ] = None,
    junit: JunitOption = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write report.html at the end.")
    ] = True,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """
    Run a scenario, in real time or lockstep, here or on the machines of an inventory, and end with a verdict.

    With --check: its plan, whether it can keep real time, and whether every machine has what it needs; ends
    with 0, 2 or 3.
    """
    console = Console(json=json, quiet=quiet)
    if junit is not None and (check or detach):
        raise InputError("--junit writes the verdict: leave out --check and --detach")
    prepare_junit(junit)
    duration = [] if duration_s is None else [f"time.duration_s={duration_s!r}"]
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
    with told_as_options({"time.duration_s": "--duration"}, set_ or ()):
        checked = load_scenario(scenario, [*(set_ or ()), *duration], warn=console.warn)
    if check:
        raise typer.Exit(_check(console, checked, options, tuple(inventory or ()), limit))
    _run(console, checked, options, junit)


def _run(console: Console, checked: ScenarioFile, options: RunOptions, junit: Path | None) -> None:
    """Run, and end with the verdict; or without, where the run goes on by itself."""
    started_utc, started_s = utc_now(), time.monotonic()
    try:
        summary = execute(checked, options, partial(make_view, quiet=console.quiet), console.say)
    except (CosmosError, MadnsError) as error:
        if junit is not None:
            # A file of an earlier run would tell of this one that it passed.
            with contextlib.suppress(InputError):
                _write_failure(junit, checked, str(error), started_s, started_utc)
        raise
    say = console.say if console.json else console.data
    if isinstance(summary, Detached):
        console.print_json(summary.to_mapping())
        return say(summary.words)
    try:
        if junit is not None:
            case = junit_case_of(checked.path, summary.run.path, summary.document)
            seconds = time.monotonic() - started_s
            write_junit(
                junit, [replace(case, seconds=seconds)], seconds=seconds, started_utc=started_utc
            )
    finally:  # a disk that is full by now takes no file, and the verdict is told all the same
        with losing_output(f"{summary.verdict.text}; it stands in {summary.run.run_json}"):
            console.print_json(dict(summary.document))
            say(summary.last_line)
    raise typer.Exit(int(summary.exit_code))


def _write_failure(
    junit: Path, checked: ScenarioFile, why: str, started_s: float, started_utc: str
) -> None:
    """Write JUnit XML of a run that came to no verdict."""
    case = JunitCase(
        classname=str(checked.path),
        name=checked.scenario.name,
        seconds=time.monotonic() - started_s,
        failure=why.partition("\n")[0],
        details=why,
        properties=(("seed", str(checked.scenario.seed)),),
    )
    write_junit(junit, [case], seconds=case.seconds, started_utc=started_utc)


def _check(
    console: Console,
    scenario: ScenarioFile,
    options: RunOptions,
    inventory: tuple[str, ...],
    limit: str | None,
) -> int:
    with IMPORT_TURN:
        # A seventh of a run's start, which --check alone has use for.
        from cosmos_cli.launch import rehearsal, rehearsal_view

    chosen_access(scenario.scenario.recording)
    asked = rehearsal_view.Asked(
        scenario=scenario.path, inventory=inventory, limit=limit, host=options.host
    )
    planned = rehearsal.Rehearsal(
        plan=plan_of(scenario, options),
        scenario=scenario,
        runs=options.runs,
        options=options.connecting,
        forks=options.forks,
    )
    return rehearsal_view.check_run(console, planned, asked)
