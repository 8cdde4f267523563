"""Living processes of runs, here and on other machines, and how those there are ended."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from cosmos_cli.collect.machine_sources import RecordingMachine
from cosmos_cli.collect.retrieval_state import asked_sources
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.run_index import remembered_runs
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.target import Target, machines_of, target_of
from cosmos_cli.launch.machines import PARTS
from cosmos_cli.models.inventory_arguments import refuse_stray_limit
from cosmos_cli.onboard.processes import RunEnding, run_directory
from cosmos_cli.system.import_turn import IMPORT_TURN
from madns_runtime.bounded_files import real_path
from madns_runtime.processes import ProcessEntry, list_processes

ROLE_ORDER = ("operator", "host", "supervisor", "agent")
ANSWER_MARGIN_S = 10.0
RUNNING = "running"

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Seen:
    """A process that lives on another machine."""

    machine: str
    entry: ProcessEntry
    age_s: float

    @property
    def directory(self) -> str:
        """The run's, there."""
        return run_directory(self.entry)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fleetwide:
    """Settings by which machines are asked."""

    options: ConnectOptions
    forks: int
    tell: Callable[[Outcome[Any]], None] = lambda outcome: None
    """Called as each machine is done."""

    def look(self, targets: Iterable[Target]) -> list[Outcome[list[Seen]]]:
        """Ask machines what lives there of any run."""

        def ask(target: Target, helper: Helper) -> list[Seen]:
            arguments = {"state": Layout(target.root).state, "ages": True}
            listed = helper.call("processes", arguments).value
            return [_seen(target.name, dict(mapping)) for mapping in listed]

        return self._each(list(targets), ask)

    def end(
        self, sources: Sequence[RecordingMachine], *, clean_s: float, forced_s: float
    ) -> list[Outcome[RunEnding]]:
        """End one run on machines, each in its own directory."""
        by_name = {source.machine: source for source in sources}

        def ask(target: Target, helper: Helper) -> RunEnding:
            arguments = {
                "state": by_name[target.name].state,
                "directory": by_name[target.name].directory,
                "clean_s": clean_s,
                "forced_s": forced_s,
            }
            # An operator there, then those that it leads, then force.
            timeout_s = 2 * (clean_s + forced_s) + ANSWER_MARGIN_S
            return RunEnding.from_mapping(
                helper.call("end_run", arguments, timeout_s=timeout_s).value
            )

        return self._each([source.target for source in sources], ask)

    def _each(
        self, targets: Sequence[Target], task: Callable[[Target, Helper], T]
    ) -> list[Outcome[T]]:
        # Imported late: without machines none of it is needed.
        with IMPORT_TURN:
            from cosmos_cli.fleet.open_connection import connect

        def work(target: Target) -> T:
            with (
                contextlib.closing(connect(target, self.options)) as connection,
                Helper.start(connection, PARTS) as helper,
            ):
                return task(target, helper)

        return for_each(targets, work, forks=self.forks, on_done=self.tell) if targets else []


def _seen(machine: str, mapping: dict[str, Any]) -> Seen:
    age_s = float(mapping.pop("age_s"))
    return Seen(machine, ProcessEntry(**mapping), age_s)


def unfinished_runs() -> list[RunDirectory]:
    """Return this user's runs on other machines that nobody has judged yet: they may go on by themselves."""
    runs = [RunDirectory(path) for path in remembered_runs()]
    return [
        run
        for run in runs
        if (run.read_json(run.run_json) or {}).get("status") == RUNNING and asked_sources(run)
    ]


def targets_of(inventory: Sequence[str] | None, limit: str | None) -> list[Target]:
    """
    Return the machines of an inventory; none without one.

    Raises:
        InputError: Faults of the inventory or the pattern; or a pattern, and no inventory that it could mean.
    """
    if not inventory:
        refuse_stray_limit(limit)
        return []
    return [target_of(machine) for machine in machines_of(inventory, limit)]


def by_name(targets: Iterable[Target]) -> dict[str, Target]:
    """Return machines as `ConnectOptions.listed` takes them."""
    return {target.name: target for target in targets}


def distinct(targets: Iterable[Target]) -> list[Target]:
    """
    Return each machine once.

    Two that are called alike, but have different addresses, may be of two laboratories, also where one is of a run and
    the other of an inventory. That the inventory knows better where a board is by now, `ConnectOptions.listed` says.
    """
    return list({(t.name, t.address, t.user, t.port, t.root): t for t in targets}.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class LivingRun:
    """One run of which at least one process lives here."""

    run: str
    directory: str
    processes: tuple[ProcessEntry, ...]

    def of_role(self, *roles: str) -> tuple[ProcessEntry, ...]:
        """Return the processes in these roles."""
        return tuple(entry for entry in self.processes if entry.role in roles)


def is_called(run: str, directory: str, which: str) -> bool:
    """Tell whether *which* is the name, number or directory of a run."""
    if os.sep in which:
        return real_path(which) == real_path(directory)
    number = run.split("-", 1)[0]
    # Compared as digits: Python makes no number of more than some thousands of them.
    is_number = which.isdecimal() and number.isdecimal() and _digits(which) == _digits(number)
    return which == run or is_number


def _digits(number: str) -> str:
    return number.lstrip("0") or "0"


def living_runs() -> list[LivingRun]:
    """Return every run that lives here, by name."""
    runs: dict[tuple[str, str], list[ProcessEntry]] = {}
    for entry in list_processes():
        runs.setdefault((entry.run, run_directory(entry)), []).append(entry)
    return [
        LivingRun(run=run, directory=directory, processes=in_order(entries))
        for (run, directory), entries in sorted(runs.items())
    ]


def in_order(entries: list[ProcessEntry]) -> tuple[ProcessEntry, ...]:
    """Return processes as people look for them: operator, host, supervisors, agents; last in roles of another version."""
    ranks = {role: rank for rank, role in enumerate(ROLE_ORDER)}
    return tuple(
        sorted(entries, key=lambda e: (ranks.get(e.role, len(ranks)), e.role, e.name, e.pid))
    )
