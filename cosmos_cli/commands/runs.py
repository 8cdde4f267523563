"""`cosmos runs`: what was run, and how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cosmos_cli.console import Column, Console, JsonOption, QuietOption
from cosmos_cli.rundir import RunDirectory, list_runs, runs_root
from madns_runtime.processes import list_processes

RunsOption = Annotated[
    Path | None,
    typer.Option(
        "--runs", metavar="DIRECTORY", help="Folder of all runs; else COSMOS_RUNS or ./runs."
    ),
]
COLUMNS = (
    Column("run"),
    Column("status"),
    Column("exit", is_number=True),
    Column("agents", is_number=True),
    Column("duration", is_number=True),
    Column("started (UTC)"),
    Column("verdict"),
)
VERDICT_CHARACTERS_MAX = 60


def runs(
    folder: RunsOption = None, as_json: JsonOption = False, quiet: QuietOption = False
) -> None:
    """List the runs, oldest first."""
    console = Console(json=as_json, quiet=quiet)
    root = runs_root(folder)
    living = {Path(entry.run_directory).resolve() for entry in list_processes()}
    found = [_entry(run, is_living=run.path in living) for run in list_runs(root)]
    console.print_json(found)
    if found:
        console.table(COLUMNS, [_row(entry) for entry in found])
    else:
        console.say(f"{root}: no runs yet; make one with: cosmos run SCENARIO")


def _entry(run: RunDirectory, *, is_living: bool) -> dict[str, Any]:
    document = run.read_json(run.run_json) or {}
    agents = document.get("agents")
    status = document.get("status", "unknown") if run.path.is_dir() else "packed"
    if status == "running" and not is_living:
        status = "cut off"
    return {
        "run": run.name,
        "path": str(run.path if run.path.is_dir() else run.bundle),
        "status": status,
        "exit_code": document.get("exit_code"),
        "agents": agents.get("count") if isinstance(agents, dict) else None,
        "duration_s": document.get("duration_s"),
        "started_utc": document.get("started_utc"),
        "verdict": document.get("verdict"),
    }


def _row(entry: dict[str, Any]) -> list[str]:
    duration_s = entry["duration_s"]
    verdict = entry["verdict"] or ""
    if len(verdict) > VERDICT_CHARACTERS_MAX:
        verdict = verdict[: VERDICT_CHARACTERS_MAX - 3] + "..."
    return [
        entry["run"],
        entry["status"],
        _shown(entry["exit_code"]),
        _shown(entry["agents"]),
        "-" if duration_s is None else f"{duration_s:g} s",
        _shown(entry["started_utc"])[:19].replace("T", " "),
        verdict,
    ]


def _shown(value: object) -> str:
    return "-" if value is None else str(value)
