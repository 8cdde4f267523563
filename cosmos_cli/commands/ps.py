"""`cosmos ps`: what runs, here and on the machines of runs."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from cosmos_cli.collect.machine_sources import RecordingMachines
from cosmos_cli.collect.retrieval_state import asked_sources
from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    LimitOption,
    SomeInventoryOption,
    ask_whether_moved,
    where_words,
)
from cosmos_cli.errors import ExitCode
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.outcome import Outcome, failed, failure_teller
from cosmos_cli.fleet.retry_file import offer_retry_of
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.living_processes import (
    Fleetwide,
    LivingRun,
    Seen,
    by_name,
    distinct,
    in_order,
    is_called,
    living_runs,
    targets_of,
    unfinished_runs,
)
from cosmos_cli.onboard.processes import age_s
from cosmos_cli.ui.console import Column, Console, JsonOption, QuietOption
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from madns_runtime.processes import ProcessEntry

HERE = "(here)"
COLUMNS = (
    Column("run"),
    Column("machine"),
    Column("role"),
    Column("name"),
    Column("pid", is_number=True),
    Column("age", is_number=True),
    Column("directory"),
)


@dataclass(frozen=True, slots=True)
class RunProcesses:
    """Living processes of one run on one machine."""

    run: str
    machine: str | None
    """None for this computer."""
    directory: str
    ages_s: dict[int, float]
    """By process."""
    processes: tuple[ProcessEntry, ...]


def ps(
    run: Annotated[
        str | None,
        typer.Argument(metavar="RUN", help="Number, name or directory of a run; default: all."),
    ] = None,
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    all_: Annotated[
        bool, typer.Option("--all", help="A line per agent, not only their number.")
    ] = False,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    List the processes of living runs: here, and on the machines that those runs were started on.

    With an inventory, whatever lives on its machines. Ends with 3 when a machine does not answer.
    """
    console = Console(json=json, quiet=quiet)
    here = living_runs()
    directories = _directories(here, run)
    planned = [source.target for each in directories for source in asked_sources(each)]
    listed = _others(targets_of(inventory, limit))
    fleet = Fleetwide(
        options=ConnectOptions(accept_new_host_keys=accept_new_host_keys, listed=by_name(listed)),
        forks=forks,
        tell=failure_teller(console.say),
    )
    outcomes = fleet.look(_others(distinct([*planned, *listed])))
    living = [*_here(here), *_there(outcomes)]
    found = [each for each in living if run is None or is_called(each.run, each.directory, run)]
    found.sort(key=lambda each: (each.run, each.machine or ""))
    rows = [row for each in found for row in _rows(each, is_every_agent=all_)]
    if rows:
        console.table(COLUMNS, rows)
    bad = failed(outcomes)
    if not rows:
        where = where_words(len(outcomes) - len(bad))
        console.say(f"no run lives {where}" if run is None else _unknown_words(run, where, living))
    if bad:
        unasked = compact(dict.fromkeys(outcome.machine for outcome in bad))
        console.say(f"whether a run lives there is not known: {unasked} could not be asked")
    failures = [outcome.failure for outcome in bad]
    ask_whether_moved(console, failures, inventory, shlex.join(["ps", *([run] if run else [])]))
    exit_code = ExitCode.MACHINES if bad else ExitCode.OK
    retry = offer_retry_of(console, inventory, listed, [outcome.machine for outcome in bad])
    console.print_json(
        {
            "runs": _mappings(found, directories),
            "machines": [outcome.to_mapping() for outcome in outcomes],
            "retry": retry,
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


def _unknown_words(which: str, where: str, living: Sequence[RunProcesses]) -> str:
    names = ", ".join(sorted({each.run for each in living})) or "none"
    return f"{which}: no such run lives {where}; living runs: {names}"


def _others(targets: Sequence[Target]) -> list[Target]:
    return [target for target in targets if target.connection != "local"]


def _directories(here: Sequence[LivingRun], which: str | None) -> list[RunDirectory]:
    """Return the runs whose machines are asked: those that live here, and those that may live elsewhere."""
    runs = {Path(run.directory): RunDirectory(Path(run.directory)) for run in here}
    runs |= {run.path: run for run in unfinished_runs()}
    return [
        run for run in runs.values() if which is None or is_called(run.name, str(run.path), which)
    ]


def _here(runs: Sequence[LivingRun]) -> list[RunProcesses]:
    return [
        RunProcesses(
            run.run, None, run.directory, {e.pid: age_s(e) for e in run.processes}, run.processes
        )
        for run in runs
    ]


def _there(outcomes: Sequence[Outcome[list[Seen]]]) -> list[RunProcesses]:
    found: dict[tuple[str, str, str], dict[ProcessEntry, float]] = {}
    for outcome in outcomes:  # a machine that is reached by two ways tells the same twice
        for seen in outcome.value or ():
            ages_s = found.setdefault((seen.entry.run, seen.machine, seen.directory), {})
            ages_s[seen.entry] = seen.age_s
    return [
        RunProcesses(
            run,
            machine,
            directory,
            {entry.pid: age_s for entry, age_s in ages_s.items()},
            in_order(list(ages_s)),
        )
        for (run, machine, directory), ages_s in found.items()
    ]


def _rows(own: RunProcesses, *, is_every_agent: bool) -> list[list[str]]:
    machine = own.machine or HERE
    agents = [entry for entry in own.processes if entry.role == "agent"]
    shown = [entry for entry in own.processes if is_every_agent or entry.role != "agent"]
    rows = [
        [
            own.run,
            machine,
            e.role,
            e.name,
            str(e.pid),
            age_words(own.ages_s[e.pid]),
            own.directory,
        ]
        for e in shown
    ]
    if agents and not is_every_agent:
        # One process may hold several agents; its name lists them.
        count = sum(len(entry.name.split(",")) for entry in agents)
        oldest = age_words(max(own.ages_s[entry.pid] for entry in agents))
        rows.append(
            [own.run, machine, "agents", counted(count, "agent"), "", oldest, own.directory]
        )
    return rows


def _mappings(
    found: Sequence[RunProcesses], directories: Sequence[RunDirectory]
) -> list[dict[str, Any]]:
    """Return a mapping a run; its directory is the one here, where it has one."""
    here = {
        source.directory: str(run.path)
        for run in directories
        for source in RecordingMachines.read(run).remote
    }
    runs: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for each in found:
        directory = each.directory if each.machine is None else here.get(each.directory)
        key = (each.run, directory or each.directory)
        runs.setdefault(key, []).extend(
            process_mapping(entry, each.ages_s[entry.pid], each.machine) for entry in each.processes
        )
    return [
        {"run": run, "directory": directory, "processes": processes}
        for (run, directory), processes in runs.items()
    ]


def process_mapping(entry: ProcessEntry, age: float, machine: str | None) -> dict[str, Any]:
    """Return a process as --json shows it."""
    return {
        "machine": machine,
        "role": entry.role,
        "name": entry.name,
        "pid": entry.pid,
        "age_s": round(age, 1),
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
