"""`cosmos collect`: brings a run's records here, judges and packages it again, or what a cut-off run left behind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from cosmos_cli.commands.fleet_options import FORKS_DEFAULT, AcceptHostKeysOption, ForksOption
from cosmos_cli.commands.runs import RunsOption
from cosmos_cli.console import Console, JsonOption, QuietOption, losing_output
from cosmos_cli.counted import counted
from cosmos_cli.errors import ExitCode
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.problem import Problem
from cosmos_cli.progress import told_progress
from cosmos_cli.rundir import RunDirectory, alone, find_run, runs_root
from cosmos_cli.still_running import still_running
from madns_runtime.processes import list_processes

if TYPE_CHECKING:
    from cosmos_cli.fleet.outcome import Outcome
    from cosmos_cli.retrieve import Retrieval, Retrieved

RunArgument = Annotated[
    str, typer.Argument(metavar="RUN", help="Number, name or path of a run, or: last.")
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
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Bring the records of a run here, and make of them tables, a report and a package.

    What a machine has is fetched, verified, and only then deleted there; a transfer that was cut goes
    on where it ended. Ends with 5 when data are missing or cut, whatever the run itself ended with.
    """
    from cosmos_cli.collect import collect_run, refuse_living

    console = Console(json=as_json, quiet=quiet)
    found = find_run(runs_root(folder), run)
    refuse_living(found, list_processes())
    options = ConnectOptions(accept_new_host_keys=accept_new_host_keys)
    with alone(found):
        problems = _retrieved(found, console, options, forks if retrieve else None)
        with told_progress(console, found.name) as progress:
            summary = collect_run(found, problems=problems, progress=progress)
    for line in summary.missing:
        console.warn(line)
    with losing_output(f"{summary.verdict.text}; it stands in {found.run_json}"):
        console.print_json(summary.document)
        # The verdict where `run` puts it: on stdout, or beside JSON as talk.
        (console.say if as_json else console.data)(summary.last_line)
        if summary.is_packed:
            console.say(f"packed: {found.bundle}")
    return int(ExitCode.DATA_INCOMPLETE if summary.missing else ExitCode.OK)


def _retrieved(
    run: RunDirectory, console: Console, options: ConnectOptions, forks: int | None
) -> tuple[Problem, ...]:
    """Fetch what lies on machines, unless *forks* is None, and return whose records have not come."""
    from cosmos_cli.retrieve import Retrieval, problems_of

    with told_progress(console, run.name) as progress:
        retrieval = Retrieval(run, options=options, forks=forks or 1, progress=progress)
        due = retrieval.due
        if not due:
            return ()
        if forks is None:
            return tuple(
                Problem(machine=each.machine, text=NOT_ASKED, step="collect") for each in due
            )
        outcomes = _fetch(run, retrieval, progress)
    tell_outcomes(console, [o for o in outcomes if o.machine in {each.machine for each in due}])
    return problems_of(outcomes)


def _fetch(
    run: RunDirectory, retrieval: Retrieval, progress: Callable[[str, float], None]
) -> list[Outcome[Retrieved]]:
    with retrieval:
        progress(f"asking {counted(len(retrieval.due), 'machine')}", 0.0)
        living = retrieval.find_living()
        if living:
            raise still_running(run.name, living)
        return retrieval.fetch()


def tell_outcomes(console: Console, outcomes: Sequence[Outcome[Retrieved]]) -> None:
    """Say of each machine what has come, or why it has not."""
    width = max((len(outcome.machine) for outcome in outcomes), default=0)
    for outcome in outcomes:
        if outcome.value is not None:
            words = f"{outcome.value.words}  ({outcome.duration_s:.1f} s)"
        else:
            words = f"failed: {outcome.failure}"
        console.say(f"{outcome.machine:{width}}  {words}")
