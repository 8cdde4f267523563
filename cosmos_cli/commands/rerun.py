"""`cosmos rerun`: a recorded run flown again in lockstep, with its devices played back."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.collect.finished_run import collected_document
from cosmos_cli.commands.run_arguments import RunArgument, RunsOption
from cosmos_cli.diff.compare import Selection, compare
from cosmos_cli.diff.side import open_side
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.launch.execute import Detached, RunOptions, execute
from cosmos_cli.rerun.actions import action_remarks
from cosmos_cli.rerun.device_comparison import compare_devices
from cosmos_cli.rerun.early_ends import (
    leave_out_after_ends,
    leave_out_after_simulated_time,
    leave_out_unwritten,
)
from cosmos_cli.rerun.expectations import compare_expectations
from cosmos_cli.rerun.flown_software import (
    installed_remarks,
    recorded_software,
    software_remarks,
    told_as_gap,
    version_remarks,
)
from cosmos_cli.rerun.outcome import RerunOutcome, print_outcome
from cosmos_cli.rerun.recorded_run import (
    FlownRun,
    read_recorded_run,
    scenario_folder,
)
from cosmos_cli.rerun.scenario import make_rerun
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.progress import told_progress
from cosmos_cli.view.factory import make_view


def rerun(
    run: RunArgument,
    as_recorded: Annotated[
        bool,
        typer.Option(
            "--as-recorded", help="Fly the run's own copy of its software; default: today's."
        ),
    ] = False,
    as_recorded_from: Annotated[
        Path | None,
        typer.Option(
            "--as-recorded-from",
            metavar="DIR",
            help="Fly the software in DIR, a copy of the scenario's folder as it was.",
        ),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """
    Fly a recorded run again without its hardware: in lockstep, each device played back from its records.

    Its checks are judged on the rerun too, and its timeline takes place again. Today's software flies where it can be stepped, and what of it differs from what was flown is named. Ends with 0 when all that is compared is the same, with 1 when
    something differs, with 2 when the run cannot be flown again; with 1, 3 (a machine) or 130 (interrupted) and an error when the rerun itself fails.
    """
    if as_recorded and as_recorded_from is not None:
        raise InputError("--as-recorded and --as-recorded-from DIR: give one of them")
    console = Console(
        json=as_json, quiet=quiet, instead="the exit code tells whether all is the same"
    )
    root = runs_root(folder)
    found = find_run(root, run)
    with ExitStack() as stack:
        software = as_recorded_from
        if as_recorded:
            collected_document(found, run)
            software = stack.enter_context(recorded_software(found, scenario_folder(found)))
        recorded = read_recorded_run(found, run, software)
        if as_recorded:
            remarks = version_remarks(found)
        else:
            which = "today's" if software is None else f"{software}: the"
            remarks = software_remarks(found, recorded.folder, which)
        if software is not None:
            remarks += installed_remarks(recorded.config.simulation)
        outcome = _fly(recorded, console, root, given=run, remarks=remarks)
    console.print_json(outcome.to_mapping())
    print_outcome(console, outcome)
    raise typer.Exit(int(ExitCode.OK if outcome.is_same else ExitCode.RUN_FAILED))


def _fly(
    recorded: FlownRun, console: Console, root: Path, *, given: str, remarks: tuple[str, ...]
) -> RerunOutcome:
    with told_as_gap(recorded.run, recorded.folder):
        flown = make_rerun(recorded)
    remarks += flown.remarks
    for remark in remarks:
        console.say(remark)
    before = open_side(recorded.run, given)
    summary = execute(
        flown.scenario,
        RunOptions(runs=root, has_report=False),
        partial(make_view, quiet=console.quiet),
        console.say,
    )
    assert not isinstance(summary, Detached)  # nobody asked for it
    summary.refuse_failed()
    console.say(summary.last_line)
    with told_progress(console, "rerun") as progress:
        after = open_side(summary.run, summary.run.name)
        streams = compare(before, after, Selection(), progress)
        remarks += leave_out_after_ends(
            streams.streams, flown.ends, before.tick_hz, recorded.killed
        )
        remarks += leave_out_unwritten(streams.only_b, flown.ends)
        if not recorded.config.time.is_lockstep:
            end_s = float(summary.document["duration_s"])
            remarks += leave_out_after_simulated_time(streams.streams, end_s)
        return RerunOutcome(
            devices=compare_devices(recorded, summary.run.path, flown.ends),
            streams=streams,
            remarks=(*remarks, *action_remarks(recorded.run, summary.run, flown.left_out)),
            unlike=flown.unlike,
            expectations=compare_expectations(recorded.run, summary.run),
            is_exact=flown.is_exact,
        )
