"""`cosmos bench suite`: scenarios one after the other, with the thesis's tables of round trips."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.bench.child_run import run_arguments
from cosmos_cli.bench.suite import SUMMARY, run_suite, suite_exit_code, suite_files
from cosmos_cli.commands.fleet_command import (
    HostOption,
    LimitOption,
    SomeInventoryOption,
    some_machines,
)
from cosmos_cli.commands.run_arguments import RunsOption
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.overrides import told_as_options
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, SetOption
from cosmos_cli.ui.plural import counted

MINUTES_MAX = 60.0 * 24 * 30


def suite(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="Scenario files, or a folder: its benchmark_*.yaml."
        ),
    ],
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes",
            metavar="M",
            min=0.01,
            max=MINUTES_MAX,
            help="Of each run, instead of the file's.",
        ),
    ] = None,
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    host: HostOption = None,
    set_: SetOption = None,
    runs: RunsOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Run benchmark scenarios one after the other, shortest first, and print their round trips by agent and overall.

    Round trips as agents saw them and as the host did, packets lost, ticks missed; each run is an ordinary one.
    Ends with the exit code of the first run that did not pass.
    """
    console = Console(
        json=json, quiet=quiet, instead=f"the runs go on, and lie in {runs_root(runs)}"
    )
    some_machines(inventory, limit, host)
    settings = list(set_ or ())
    settings += [] if minutes is None else [f"time.duration_s={minutes * 60!r}"]
    with told_as_options({"time.duration_s": "--minutes"}, set_ or ()):
        scenarios = [
            load_scenario(path, settings, warn=console.warn) for path in suite_files(files)
        ]
    options = run_arguments(inventory=inventory, limit=limit, host=host, settings=settings)
    total_s = sum(each.scenario.time.duration_s for each in scenarios)
    console.say(f"{counted(len(scenarios), 'run')} of {total_s / 60:.3g} minutes together")
    start_s = time.monotonic()
    done = run_suite(scenarios, options, runs_root(runs), console)
    if len(scenarios) > 1:
        console.table(SUMMARY, [row for each in done for row in each.summary_rows()])
    exit_code = suite_exit_code(done)
    passed = sum(each.outcome.exit_code == 0 for each in done)
    console.data(
        f"{passed} of {counted(len(scenarios), 'run')} passed in {time.monotonic() - start_s:.0f} s;"
        f" they lie in {runs_root(runs)}"
    )
    console.print_json({"runs": [each.to_mapping() for each in done], "exit_code": exit_code})
    return exit_code
