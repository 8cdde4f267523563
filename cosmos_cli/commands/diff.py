"""`cosmos diff`: what differs between two runs, or between two scenarios that are run for it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.runs import RunsOption
from cosmos_cli.diff.compare import Selection, compare
from cosmos_cli.diff.document import to_document
from cosmos_cli.diff.side import open_side
from cosmos_cli.diff.terminal import print_comparison
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import RunDirectory, runs_root
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.launch.execute import Detached, RunOptions, execute
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, SetOption
from cosmos_cli.ui.progress import told_progress
from cosmos_cli.view.factory import make_view


def diff(
    a: Annotated[str, typer.Argument(metavar="A", help="Number, name or path of a run, or: last.")],
    b: Annotated[str, typer.Argument(metavar="B", help="The run to compare it with.")],
    agents: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help="Only agents of this name. Repeatable."),
    ] = None,
    streams: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOB",
            help="Only streams of this name, such as state; '*' for the framework's own, too. Repeatable.",
        ),
    ] = None,
    expect_same: Annotated[
        bool, typer.Option("--expect-same", help="End with 1 if the records differ.")
    ] = False,
    run_first: Annotated[
        bool, typer.Option("--run", help="A and B are scenarios: run one, then the other, first.")
    ] = False,
    set_: SetOption = None,
    duration_s: Annotated[
        float | None,
        typer.Option("--duration", metavar="S", help="With --run: simulated time of both, s."),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """
    Compare two runs: settings, timing, and record by record what their simulation recorded.

    Ends with 0 when they were compared, whatever was found; with --expect-same, 1 when their records differ.
    """
    console = Console(json=as_json, quiet=quiet)
    code = ExitCode.OK
    if run_first:
        found, code = _run_both((a, b), console, folder, overrides=_overrides(set_, duration_s))
    elif set_ or duration_s is not None:
        raise InputError(
            "--set and --duration change scenarios; give them with --run A.yaml B.yaml"
        )
    else:
        root = runs_root(folder)
        found = (find_run(root, a), find_run(root, b))
    sides = open_side(found[0], a), open_side(found[1], b)
    chosen = tuple(agents or ())
    labelled = (name for run in found for name in run_labels(run).labelled(chosen))
    selection = Selection(agents=(*chosen, *labelled), streams=tuple(streams or ()))
    with told_progress(console, "diff") as progress:
        comparison = compare(*sides, selection, progress)
    console.print_json(to_document(comparison))
    print_comparison(console, comparison)
    if code is ExitCode.OK and expect_same and not comparison.is_same:
        code = ExitCode.RUN_FAILED
    raise typer.Exit(int(code))


def _overrides(set_: list[str] | None, duration_s: float | None) -> list[str]:
    overrides = list(set_ or ())
    if duration_s is not None:
        overrides.append(f"time.duration_s={duration_s!r}")
    return overrides


def _run_both(
    paths: tuple[str, str], console: Console, folder: Path | None, *, overrides: list[str]
) -> tuple[tuple[RunDirectory, RunDirectory], ExitCode]:
    """Run two scenarios one after the other; both are checked before the first starts."""
    first, second = (load_scenario(Path(path), overrides, warn=console.warn) for path in paths)
    if first.scenario.simulation != second.scenario.simulation:
        raise InputError(
            f"expected two scenarios of one simulation, got {paths[0]} of"
            f" {first.scenario.simulation} and {paths[1]} of {second.scenario.simulation}"
        )
    root = runs_root(folder)
    run_a, code_a = _run_one(first, console=console, root=root)
    if code_a in (ExitCode.RUN_FAILED, ExitCode.MACHINES, ExitCode.INTERRUPTED):
        raise typer.Exit(int(code_a))
    run_b, code_b = _run_one(second, console=console, root=root)
    return (run_a, run_b), code_a if code_a is not ExitCode.OK else code_b


def _run_one(
    scenario: ScenarioFile, *, console: Console, root: Path
) -> tuple[RunDirectory, ExitCode]:
    summary = execute(
        scenario, RunOptions(runs=root), partial(make_view, quiet=console.quiet), console.say
    )
    assert not isinstance(summary, Detached)  # nobody asked for it
    console.say(summary.last_line)
    return summary.run, summary.exit_code
