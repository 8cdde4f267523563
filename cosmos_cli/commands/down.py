"""`cosmos down`: end runs from outside, and only what they started."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cosmos_cli.console import Console, JsonOption, QuietOption
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.fleet.onboard.processes import Ending
from cosmos_cli.launch.living import LivingRun, end_run, living_runs
from madns_runtime.processes import ProcessEntry

CLEAN_TIMEOUT_S = 30.0
FORCED_TIMEOUT_S = 5.0


def down(
    runs: Annotated[
        list[str] | None,
        typer.Argument(metavar="RUN...", help="Names, numbers or directories of runs."),
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="End every living run.")] = False,
    timeout_s: Annotated[
        float, typer.Option("--timeout", metavar="S", min=0.0, help="Time for a clean shutdown, s.")
    ] = CLEAN_TIMEOUT_S,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """End runs on this machine: cleanly if they can, by force if they must."""
    console = Console(json=json, quiet=quiet)
    chosen = choose(living_runs(), runs or [], is_all=all_)
    endings = [
        end_run(run, clean_s=timeout_s, forced_s=FORCED_TIMEOUT_S, say=console.say)
        for run in chosen
    ]
    for ending in endings:
        console.data(_words(ending))
    if not chosen:
        console.say("no run lives on this machine")
    console.print_json({"runs": [_mapping(ending) for ending in endings]})
    if any(ending.left for ending in endings):
        raise typer.Exit(ExitCode.RUN_FAILED)


def choose(living: list[LivingRun], wanted: list[str], *, is_all: bool) -> list[LivingRun]:
    """
    Return the living runs that are meant.

    Raises:
        InputError: Nothing or something unknown was named, or a name that fits several.
    """
    if is_all:
        return living
    known = ", ".join(run.run for run in living) or "none"
    if not wanted:
        raise InputError(f"name the runs to end, or give --all; living runs: {known}")
    chosen: list[LivingRun] = []
    for which in wanted:
        found = [run for run in living if run.is_called(which)]
        if not found:
            raise InputError(f"{which}: no such run lives on this machine; living runs: {known}")
        if len(found) > 1:
            directories = ", ".join(run.directory for run in found)
            raise InputError(f"{which}: several living runs; give the directory: {directories}")
        chosen += [run for run in found if run not in chosen]
    return chosen


def _words(ending: Ending) -> str:
    if ending.left:
        pids = ", ".join(str(entry.pid) for entry in ending.left)
        return f"{ending.run}: still living: {pids}"
    by_force = f", {len(ending.killed)} of them by force" if ending.killed else ""
    return f"{ending.run}: ended {len(ending.ended)} processes{by_force}"


def _mapping(ending: Ending) -> dict[str, Any]:
    return {
        "run": ending.run,
        "ended": [_process(entry) for entry in ending.ended],
        "killed": [_process(entry) for entry in ending.killed],
        "left": [_process(entry) for entry in ending.left],
    }


def _process(entry: ProcessEntry) -> dict[str, Any]:
    return {"role": entry.role, "name": entry.name, "pid": entry.pid}
