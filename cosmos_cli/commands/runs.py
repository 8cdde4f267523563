"""`cosmos runs`: what was run, and how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cosmos_cli.commands.run_arguments import RunsOption
from cosmos_cli.evidence.run_directory import RunDirectory, list_runs, runs_root
from cosmos_cli.evidence.run_documents import fault_of, newer_schema, text_or_none
from cosmos_cli.evidence.verdict import is_number
from cosmos_cli.ui.console import Column, Console, JsonOption, QuietOption
from madns_runtime.processes import list_processes

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
    is_here = run.path.is_dir()
    document = run.read_json(run.run_json) or {}
    fault = (newer_schema(document) or fault_of(run.run_json)) if is_here else None
    agents = document.get("agents")
    count, duration_s = agents.get("count") if isinstance(agents, dict) else None, None
    if is_number(document.get("duration_s")):
        duration_s = document["duration_s"]
    status = text_or_none(document.get("status")) or "unknown" if is_here else "packed"
    if status == "running" and not is_living:
        # That of a detached run may live on a machine, and has no end here before it is collected.
        is_detached = (run.read_json(run.plan_json) or {}).get("is_detached") is True
        status = "detached" if is_detached else "cut off"
    exit_code = document.get("exit_code")
    return {
        "run": run.name,
        "path": str(run.path if is_here else run.bundle),
        "status": status,
        "exit_code": exit_code if is_number(exit_code) else None,
        "agents": count if is_number(count) else None,
        "duration_s": duration_s,
        "started_utc": text_or_none(document.get("started_utc")),
        "verdict": f"run.json: {fault}" if fault else text_or_none(document.get("verdict")),
    }


def _row(entry: dict[str, Any]) -> list[str]:
    # The key tells what was to be run: one that was cut short has not come so far.
    duration_s, is_flown = entry["duration_s"], entry["status"] == "complete"
    verdict = entry["verdict"] or ""
    if len(verdict) > VERDICT_CHARACTERS_MAX:
        verdict = verdict[: VERDICT_CHARACTERS_MAX - 3] + "..."
    return [
        entry["run"],
        entry["status"],
        _shown(entry["exit_code"]),
        _shown(entry["agents"]),
        "-" if duration_s is None else f"{duration_s:g} s{'' if is_flown else ' planned'}",
        _shown(entry["started_utc"])[:19].replace("T", " "),
        verdict,
    ]


def _shown(value: object) -> str:
    return "-" if value is None else str(value)
