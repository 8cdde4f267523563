"""`cosmos ps`: what runs on this machine."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cosmos_cli.console import Column, Console, JsonOption, QuietOption
from cosmos_cli.fleet.onboard.processes import age_s
from cosmos_cli.launch.living import LivingRun, living_runs
from madns_runtime.processes import ProcessEntry

COLUMNS = (
    Column("RUN"),
    Column("ROLE"),
    Column("NAME"),
    Column("PID", is_number=True),
    Column("AGE", is_number=True),
    Column("DIRECTORY"),
)


def ps(
    all_: Annotated[bool, typer.Option("--all", help="A line an agent, not only their number.")] = (
        False
    ),
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """List the processes of living runs on this machine."""
    console = Console(json=json, quiet=quiet)
    runs = living_runs()
    rows = [row for run in runs for row in _rows(run, is_every_agent=all_)]
    if rows:
        console.table(COLUMNS, rows)
    else:
        console.say("no run lives on this machine")
    console.print_json({"runs": [_mapping(run) for run in runs]})


def _rows(run: LivingRun, *, is_every_agent: bool) -> list[list[str]]:
    agents = run.of_role("agent")
    shown = run.processes if is_every_agent else run.of_role("operator", "host", "supervisor")
    rows = [
        [run.run, e.role, e.name, str(e.pid), age_words(age_s(e)), run.directory] for e in shown
    ]
    if agents and not is_every_agent:
        # One process may hold several agents; its name lists them.
        count = sum(len(entry.name.split(",")) for entry in agents)
        oldest_s = max(map(age_s, agents))
        rows.append([run.run, "agents", f"{count} agents", "", age_words(oldest_s), run.directory])
    return rows


def _mapping(run: LivingRun) -> dict[str, Any]:
    processes = [process_mapping(entry) for entry in run.processes]
    return {"run": run.run, "directory": run.directory, "processes": processes}


def process_mapping(entry: ProcessEntry) -> dict[str, Any]:
    """Return a process as --json shows it."""
    return {
        "role": entry.role,
        "name": entry.name,
        "pid": entry.pid,
        "age_s": round(age_s(entry), 1),
        "started_utc": entry.utc,
    }


def age_words(age: float) -> str:
    """Return an age such as 12 s, 3 min 05 s or 2 h 10 min."""
    seconds = int(age)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"
