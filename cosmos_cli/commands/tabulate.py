"""`cosmos tabulate`: the host's own record of a run as a table, at any rate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.collect.finished_run import collected_document
from cosmos_cli.collect.host_tables import Wanted, layout_with, times_of, write_host_table
from cosmos_cli.commands.run_arguments import RunArgument, RunsOption
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import alone, runs_root
from cosmos_cli.evidence.run_documents import fault_of_plan
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.evidence.table_labels import TableLabels
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.progress import told_progress

AGENTS_NAMED_MAX = 5
SUFFIXES = (".parquet", ".pq", "")
"""Of what is written; any other would tell readers of another format."""


def tabulate(
    run: RunArgument = "last",
    rate_hz: Annotated[
        float,
        typer.Option("--rate-hz", metavar="HZ", min=1e-6, help="Rows of each agent in a second."),
    ] = 1.0,
    agents: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOB", help="Only agents of this name. Repeatable."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            metavar="FILE",
            help="The Parquet file, NAME.parquet; by default truth.parquet of the run.",
        ),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Make a table of what the host itself recorded of every agent, such as the truth it sent.

    An agent that was lost has its rows here, too. Ends with 5 if nothing is on record at some of the times.
    """
    console = Console(json=as_json, quiet=quiet, instead="the table is written all the same")
    if output is not None and output.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"--output {output}: the table is a Parquet file; expected a name such as {output.stem}.parquet"
        )
    found = find_run(runs_root(folder), run)
    document, config = collected_document(found, run), found.read_config()
    if config is None:
        fault = fault_of_plan(found.plan_json) or "cannot be used"
        raise InputError(
            f"{found.plan_json}: {fault}; put it back as it was: how its records are read stands there alone"
        )
    ran_s = document.get("duration_s")
    times_s = times_of(config, ran_s if isinstance(ran_s, int | float) else None, rate_hz)
    plan, result = found.read_json(found.plan_json), found.read_json(found.result_json)
    labels = TableLabels.of(config, result, plan)
    names = _chosen(config.agents.resolved_names(), agents or [], labels.agents)
    path = output or found.host_table
    with alone(found, must_own=output is None), told_progress(console, found.name) as progress:
        wanted = Wanted(agents=names, times_s=times_s, path=path, layout=layout_with(labels))
        written = write_host_table(found, config, wanted, progress)
    for agent, count in list(written.gaps.items())[:AGENTS_NAMED_MAX]:
        console.warn(f"{agent}: nothing is on record at {count} of {len(times_s)} times")
    if len(written.gaps) > AGENTS_NAMED_MAX:
        console.warn(f"and {counted(len(written.gaps) - AGENTS_NAMED_MAX, 'agent')} more")
    console.print_json(
        {"file": str(path), "rows": written.rows, "agents": len(names), "gaps": written.gaps}
    )
    console.data(f"{written.rows} rows of {counted(len(names), 'agent')} | {path}")
    return int(ExitCode.DATA_INCOMPLETE if written.gaps else ExitCode.OK)


def _chosen(names: tuple[str, ...], globs: list[str], labels: AgentLabels) -> tuple[str, ...]:
    unknown = [glob for glob in globs if not labels.like(glob, names)]
    if unknown:
        raise InputError(
            f"--agents {unknown[0]}: no agent of the run is called so; there are {compact(names)}"
        )
    return tuple(labels.like_any(globs, names)) if globs else names
