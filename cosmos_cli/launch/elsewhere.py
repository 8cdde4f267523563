"""What lives of runs on other machines, and ending it there: found through plan.json or an inventory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.onboard.processes import Ending, run_directory
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.machines import PARTS
from cosmos_cli.retrieve.sources import Source, Sources
from cosmos_cli.rundir import RunDirectory
from cosmos_cli.runindex import remembered_runs
from madns_runtime.processes import ProcessEntry

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
    """How machines are asked."""

    options: ConnectOptions
    forks: int

    def look(self, targets: Iterable[Target]) -> list[Outcome[list[Seen]]]:
        """Ask machines what lives there of any run."""

        def ask(target: Target, board: Board) -> list[Seen]:
            arguments = {"state": Layout(target.root).state, "ages": True}
            listed = board.call("processes", arguments).value
            return [_seen(target.name, dict(mapping)) for mapping in listed]

        return self._each(list(targets), ask)

    def end(
        self, sources: Sequence[Source], *, clean_s: float, forced_s: float
    ) -> list[Outcome[Ending]]:
        """End one run on machines, each in its own directory."""
        by_name = {source.machine: source for source in sources}

        def ask(target: Target, board: Board) -> Ending:
            arguments = {
                "state": by_name[target.name].state,
                "directory": by_name[target.name].directory,
                "clean_s": clean_s,
                "forced_s": forced_s,
            }
            timeout_s = clean_s + 2 * forced_s + ANSWER_MARGIN_S
            return Ending.from_mapping(board.call("end_run", arguments, timeout_s=timeout_s).value)

        return self._each([source.target for source in sources], ask)

    def _each(
        self, targets: Sequence[Target], task: Callable[[Target, Board], T]
    ) -> list[Outcome[T]]:
        # Imported late: without machines none of it is needed.
        from cosmos_cli.fleet.connect import connect

        def work(target: Target) -> T:
            connection = connect(target, self.options)
            try:
                with Board.start(connection, PARTS) as board:
                    return task(target, board)
            finally:
                connection.close()

        return for_each(targets, work, forks=self.forks) if targets else []


def _seen(machine: str, mapping: dict[str, Any]) -> Seen:
    age_s = float(mapping.pop("age_s"))
    return Seen(machine, ProcessEntry(**mapping), age_s)


def unfinished_runs() -> list[RunDirectory]:
    """Return this user's runs on other machines that nobody has judged yet: they may go on by themselves."""
    runs = [RunDirectory(entry.path) for entry in remembered_runs()]
    return [
        run
        for run in runs
        if (run.read_json(run.run_json) or {}).get("status") == RUNNING and Sources.read(run).remote
    ]


def targets_of(inventory: Path | None, limit: str | None) -> list[Target]:
    """Return the machines of an inventory; none without one."""
    if inventory is None:
        return []
    from cosmos_cli.fleet.target import target_of
    from cosmos_cli.models.inventory import load_machines  # what checks inventories takes its time

    return [target_of(machine) for machine in load_machines(inventory, limit)]


def distinct(targets: Iterable[Target]) -> list[Target]:
    """Return each machine once: two runs, or a run and an inventory, may name the same."""
    found = {(t.name, t.address, t.user, t.port, t.root): t for t in targets}
    return list({target.name: target for target in found.values()}.values())
