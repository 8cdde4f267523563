"""`cosmos collect`: brings a run's records here, judges and packages it again, or what a cut-off run left behind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from cosmos_cli.collect.finish import collect_run
from cosmos_cli.collect.finished_run import refuse_living, still_running
from cosmos_cli.collect.machine_retrieval import Retrieved
from cosmos_cli.collect.machine_sources import RecordingMachines
from cosmos_cli.collect.retrieval_state import NONE, forget, forgotten_problems
from cosmos_cli.collect.retrieve import Retrieval, problems_of
from cosmos_cli.collect.size_bound import parse_size
from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    PresentInventoryOption,
    ask_whether_moved,
)
from cosmos_cli.commands.run_arguments import RunArgument, RunsOption
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.manifest import told_as_kept
from cosmos_cli.evidence.run_directory import RunDirectory, alone, runs_root
from cosmos_cli.evidence.run_documents import Problem
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.outcome import Outcome, failed
from cosmos_cli.launch.living_processes import by_name, targets_of
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, losing_output
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.progress import told_progress
from madns_runtime.processes import list_processes

SizeMaxOption = Annotated[
    str | None,
    typer.Option(
        "--size-max",
        metavar="SIZE",
        help="The most that a machine, or this computer in files with holes, may have of the run, such as 20GB; else by the run's plan.",
    ),
]
ForgetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--forget",
        metavar="MACHINE",
        help="Ask this machine no more, as it is gone for good; all: every one that is left;"
        " none: ask all again. Repeatable.",
    ),
]
NOT_ASKED = "its records were not fetched, as --no-retrieve says"


def collect(
    run: RunArgument = "last",
    folder: RunsOption = None,
    retrieve: Annotated[
        bool,
        typer.Option(
            "--retrieve/--no-retrieve", help="Fetch what still lies on the run's machines first."
        ),
    ] = True,
    size_max: SizeMaxOption = None,
    forget: ForgetOption = None,
    inventory: PresentInventoryOption = None,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Bring the records of a run here, and make of them tables, a report and a package.

    What a machine has is fetched, verified, and only then deleted there; a transfer that was cut goes
    on where it ended. What is forgotten stays missing. Ends with 5 when data are missing or cut, whatever the run itself ended with.
    """
    console = Console(json=as_json, quiet=quiet)
    found = find_run(runs_root(folder), run)
    refuse_living(found, list_processes())
    bytes_max = _bytes_of(size_max)
    is_asked = retrieve and bool(RecordingMachines.read(found).remote)
    options = ConnectOptions(
        accept_new_host_keys=accept_new_host_keys,
        listed=by_name(targets_of(inventory if is_asked else None, None)),
    )
    with alone(found):
        _forget(found, forget or [], console)
        with told_progress(console, found.name) as progress:
            retrieval = Retrieval(
                found,
                options=options,
                forks=forks,
                progress=progress,
                say=console.warn,
                bytes_max=bytes_max,
            )
            due = [each.machine for each in retrieval.due]
            outcomes = _fetch(found, retrieval, progress) if due and retrieve else []
        tell_outcomes(console, [outcome for outcome in outcomes if outcome.machine in due])
        failures = [outcome.failure for outcome in failed(outcomes)]
        ask_whether_moved(console, failures, inventory, f"collect {found.shell_path}")
        problems = problems_of(outcomes)
        if not retrieve:
            problems = tuple(Problem(machine=name, text=NOT_ASKED, step="collect") for name in due)
        problems += forgotten_problems(found)
        with told_progress(console, found.name) as progress:
            summary = collect_run(found, problems=problems, progress=progress, bytes_max=bytes_max)
    for line in summary.missing:
        console.warn(line)
    with losing_output(f"{summary.verdict.text}; it stands in {found.run_json}"):
        console.print_json(summary.document)
        # The verdict where `run` puts it: on stdout, or beside JSON as talk.
        (console.say if as_json else console.data)(summary.last_line)
        if summary.is_packed:
            console.say(f"packed: {found.bundle}")
        elif summary.kept_member:
            console.warn(told_as_kept(found, summary.kept_member))
    return int(ExitCode.DATA_INCOMPLETE if summary.missing else ExitCode.OK)


def _forget(run: RunDirectory, names: Sequence[str], console: Console) -> None:
    if not names:
        return
    try:
        changed = forget(run, names)
    except MachineFailure as failure:
        raise InputError(f"{run.name}: {failure}") from failure
    for machine in changed:
        if NONE in names:
            console.say(f"{machine}: is asked again")
        else:
            again = f"cosmos collect {run.name} --forget {NONE}"
            console.say(f"{machine}: is asked no more; to ask it again: {again}")


def _bytes_of(size: str | None) -> int | None:
    try:
        return None if size is None else parse_size(size)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--size-max") from None


def _fetch(
    run: RunDirectory, retrieval: Retrieval, progress: Callable[[str, float], None]
) -> list[Outcome[Retrieved]]:
    with retrieval:
        progress(f"asking {counted(len(retrieval.due), 'machine')}", 0.0)
        living = retrieval.find_living()
        if not living:
            return retrieval.fetch()
    # Behind the visit, which an error would end at once: programs of this computer would be left to themselves.
    raise still_running(run.name, living)


def tell_outcomes(console: Console, outcomes: Sequence[Outcome[Retrieved]]) -> None:
    """Say of each machine what has come, or why it has not."""
    width = max((len(outcome.machine) for outcome in outcomes), default=0)
    for outcome in outcomes:
        if outcome.value is not None:
            words = f"{outcome.value.words}  ({outcome.duration_s:.1f} s)"
        else:
            words = f"failed: {outcome.failure}"
        console.say(f"{outcome.machine:{width}}  {words}")
