"""`cosmos rerun`: a recorded run flown again in lockstep, with its devices played back."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.runs import RunsOption
from cosmos_cli.diff.compare import Selection, compare
from cosmos_cli.diff.side import open_side
from cosmos_cli.errors import ExitCode
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.launch.execute import Detached, RunOptions, execute
from cosmos_cli.rerun.device_comparison import compare_devices
from cosmos_cli.rerun.outcome import RerunOutcome, print_outcome
from cosmos_cli.rerun.recorded_run import read_recorded_run
from cosmos_cli.rerun.scenario import make_rerun
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.progress import told_progress
from cosmos_cli.view.factory import make_view

FAILED = (ExitCode.RUN_FAILED, ExitCode.MACHINES, ExitCode.INTERRUPTED)


def rerun(
    run: Annotated[
        str, typer.Argument(metavar="RUN", help="Number, name or path of a run, or: last.")
    ],
    as_recorded: Annotated[
        Path | None,
        typer.Option(
            "--as-recorded",
            metavar="DIR",
            help="Fly the software in DIR, a copy of the scenario's folder as it was; default: today's folder.",
        ),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """
    Fly a recorded run again without its hardware: in lockstep, each device played back from its records.

    Today's software flies where it can be stepped. Ends with 0 when all that is compared is the same, with 1 when
    something differs, with 2 when the run cannot be flown again.
    """
    console = Console(json=as_json, quiet=quiet)
    root = runs_root(folder)
    recorded = read_recorded_run(find_run(root, run), run, as_recorded)
    flown = make_rerun(recorded)
    for remark in flown.remarks:
        console.say(remark)
    before = open_side(recorded.run, run)
    summary = execute(
        flown.scenario,
        RunOptions(runs=root, has_report=False),
        partial(make_view, quiet=console.quiet),
        console.say,
    )
    assert not isinstance(summary, Detached)  # nobody asked for it
    console.say(summary.last_line)
    if summary.exit_code in FAILED:
        raise typer.Exit(int(summary.exit_code))
    with told_progress(console, "rerun") as progress:
        after = open_side(summary.run, summary.run.name)
        outcome = RerunOutcome(
            devices=compare_devices(recorded, summary.run.path),
            streams=compare(before, after, Selection(), progress),
            remarks=flown.remarks,
            unlike=flown.unlike,
        )
    console.print_json(outcome.to_mapping())
    print_outcome(console, outcome)
    raise typer.Exit(int(ExitCode.OK if outcome.is_same else ExitCode.RUN_FAILED))
