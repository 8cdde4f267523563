"""`cosmos diff`: differences of runs from the first, or of scenarios that are run for it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.run_arguments import RunsOption
from cosmos_cli.diff.chosen import check_chosen, check_will_be_chosen
from cosmos_cli.diff.compare import Comparison, Selection, compare
from cosmos_cli.diff.document import several_documents, to_document
from cosmos_cli.diff.page import write_comparisons
from cosmos_cli.diff.side import check_comparable, open_side
from cosmos_cli.diff.terminal import count_figures, print_comparison
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import RunDirectory, runs_root
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.launch.execute import Detached, RunOptions, execute
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.models.overrides import told_as_options
from cosmos_cli.system.named_file import HTML, check_writable, named_file
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, SetOption
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.progress import told_progress
from cosmos_cli.view.factory import make_view

RUNS_MAX = 16
"""Runs of one comparison."""


def diff(
    a: Annotated[str, typer.Argument(metavar="A", help="Number, name or path of a run, or: last.")],
    others: Annotated[
        list[str],
        typer.Argument(metavar="B...", help="Runs to compare with it, each by itself."),
    ],
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
        bool, typer.Option("--run", help="A, B, ... are scenarios: run one after the other first.")
    ] = False,
    set_: SetOption = None,
    duration_s: Annotated[
        float | None,
        typer.Option("--duration", metavar="S", help="With --run: simulated time of each, s."),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            "--html",
            metavar="FILE",
            help="Write the comparison to FILE as well, with the figures that its simulation draws.",
        ),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """
    Compare runs with the first: settings, timing, and record by record what their simulation recorded.

    Ends with 0 when they were compared, whatever was found; with --expect-same, 1 when their records differ; with --run, as a run that went wrong.
    """
    instead = "the exit code tells what was found" if expect_same or run_first else None
    console = Console(json=as_json, quiet=quiet, instead=instead)
    code = ExitCode.OK
    names = [a, *others]
    chosen = Selection(agents=tuple(agents or ()), streams=tuple(streams or ()))
    if html is not None:
        check_writable(html, HTML)
    if len(names) > RUNS_MAX:
        raise InputError(f"expected at most {RUNS_MAX} runs, got {len(names)}")
    if run_first:
        with told_as_options({"time.duration_s": "--duration"}, set_ or ()):
            scenarios = _load_all(names, console, _overrides(set_, duration_s), chosen)
            found, code = _run_all(scenarios, console, folder)
    elif set_ or duration_s is not None:
        raise InputError(
            "--set and --duration change scenarios; give them with --run A.yaml B.yaml"
        )
    else:
        root = runs_root(folder)
        found = [find_run(root, name) for name in names]
    comparisons = _compare_each(found, names, chosen, console=console)
    _tell(console, comparisons, html)
    if code is ExitCode.OK and expect_same and not all(one.is_same for one in comparisons):
        code = ExitCode.RUN_FAILED
    raise typer.Exit(int(code))


def _tell(console: Console, comparisons: Sequence[Comparison], html: Path | None) -> None:
    """Print comparisons, and write their page."""
    documents = [to_document(one) for one in comparisons]
    console.print_json(documents[0] if len(documents) == 1 else several_documents(documents))
    for comparison in comparisons:
        print_comparison(console, comparison)
    if html is not None:
        with named_file(html):
            write_comparisons(comparisons, html)
        console.say(f"comparison written to {html}")
    elif figures := sum(map(count_figures, comparisons)):
        console.say(f"{counted(figures, 'figure')} more with --html FILE")


def _overrides(set_: list[str] | None, duration_s: float | None) -> list[str]:
    overrides = list(set_ or ())
    if duration_s is not None:
        overrides.append(f"time.duration_s={duration_s!r}")
    return overrides


def _compare_each(
    found: Sequence[RunDirectory], names: Sequence[str], chosen: Selection, *, console: Console
) -> list[Comparison]:
    """Compare all runs but the first with it; that they can be compared is known before the first is read."""
    labelled = {name: None for run in found for name in run_labels(run).labelled(chosen.agents)}
    selection = Selection(agents=(*chosen.agents, *labelled), streams=chosen.streams)
    first, *others = [open_side(run, name) for run, name in zip(found, names, strict=True)]
    for other in others:
        check_comparable(first, other)
    check_chosen((first, *others), chosen)
    with told_progress(console, "diff") as progress:
        return [compare(first, other, selection, progress) for other in others]


def _load_all(
    paths: Sequence[str], console: Console, overrides: list[str], chosen: Selection
) -> list[ScenarioFile]:
    """
    Load scenarios of one simulation.

    Raises:
        InputError: One has faults, or is of another simulation, or nothing of them would be chosen by a word.
    """
    scenarios = [load_scenario(Path(path), overrides, warn=console.warn) for path in paths]
    first = scenarios[0].scenario.simulation
    for path, scenario in zip(paths, scenarios, strict=True):
        if scenario.scenario.simulation != first:
            raise InputError(
                f"expected scenarios of one simulation, got {paths[0]} of {first} and {path} of"
                f" {scenario.scenario.simulation}"
            )
    check_will_be_chosen(scenarios, chosen)
    return scenarios


def _run_all(
    scenarios: Sequence[ScenarioFile], console: Console, folder: Path | None
) -> tuple[list[RunDirectory], ExitCode]:
    """
    Run scenarios one after the other.

    Raises:
        RunFailedError: One but the last failed: no further one is run.
    """
    root = runs_root(folder)
    runs, code = [], ExitCode.OK
    for number, scenario in enumerate(scenarios, start=1):
        summary = execute(
            scenario, RunOptions(runs=root), partial(make_view, quiet=console.quiet), console.say
        )
        assert not isinstance(summary, Detached)  # nobody asked for it
        if number < len(scenarios):
            summary.refuse_failed()
        console.say(summary.last_line)
        runs.append(summary.run)
        code = summary.exit_code if code is ExitCode.OK else code
    return runs, code
