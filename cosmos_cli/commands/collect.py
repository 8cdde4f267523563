"""`cosmos collect`: gathers, judges and packages a run again, or what a cut-off run left behind."""

from __future__ import annotations

from typing import Annotated

import typer

from cosmos_cli.commands.runs import RunsOption
from cosmos_cli.console import Console, JsonOption, QuietOption, losing_output
from cosmos_cli.errors import ExitCode
from cosmos_cli.rundir import find_run, runs_root

RunArgument = Annotated[
    str, typer.Argument(metavar="RUN", help="Number, name or path of a run, or: last.")
]


def collect(
    run: RunArgument = "last",
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Gather the records of a run into tables, a report and a package.

    Ends with 5 when data are missing or cut, whatever the run itself ended with.
    """
    from cosmos_cli.collect import collect_run
    from cosmos_cli.progress import told_progress

    console = Console(json=as_json, quiet=quiet)
    found = find_run(runs_root(folder), run)
    with told_progress(console, found.name) as progress:
        summary = collect_run(found, progress=progress)
    for line in summary.missing:
        console.warn(line)
    with losing_output(f"{summary.verdict.text}; it stands in {found.run_json}"):
        console.print_json(summary.document)
        # The verdict where `run` puts it: on stdout, or beside JSON as talk.
        (console.say if as_json else console.data)(summary.last_line)
        console.say(f"packed: {found.bundle}")
    return int(ExitCode.DATA_INCOMPLETE if summary.missing else ExitCode.OK)
