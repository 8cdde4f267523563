"""What lives of runs on this computer, and ending a run from outside: only what it started, verified."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cosmos_cli.fleet.onboard.processes import Ending, end_entries, run_directory
from madns_runtime.processes import ProcessEntry, list_processes

ROLE_ORDER = ("operator", "host", "supervisor", "agent")


@dataclass(frozen=True, slots=True, kw_only=True)
class LivingRun:
    """One run of which at least one process lives here."""

    run: str
    directory: str
    processes: tuple[ProcessEntry, ...]

    def of_role(self, *roles: str) -> tuple[ProcessEntry, ...]:
        """Return the processes in these roles."""
        return tuple(entry for entry in self.processes if entry.role in roles)

    def is_called(self, which: str) -> bool:
        """Tell whether *which* is this run's name, number or directory."""
        return is_called(self.run, self.directory, which)


def is_called(run: str, directory: str, which: str) -> bool:
    """Tell whether *which* is the name, number or directory of a run."""
    if os.sep in which:
        return Path(which).resolve() == Path(directory).resolve()
    number = run.split("-", 1)[0]
    is_number = which.isdecimal() and number.isdecimal() and int(which) == int(number)
    return which == run or is_number


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
    """Return processes as people look for them: operator, host, supervisors, agents."""
    return tuple(sorted(entries, key=lambda e: (ROLE_ORDER.index(e.role), e.name, e.pid)))


def end_run(
    run: LivingRun, *, clean_s: float, forced_s: float, say: Callable[[str], None]
) -> Ending:
    """
    End what lives here of a run: its operator is asked first; then its parts; then SIGKILL.

    Args:
        run: What to end.
        clean_s: Time for a clean shutdown, s.
        forced_s: Time for each of the harder means, s.
        say: Told what is being done.
    """
    return end_entries(
        run.processes, directory=run.directory, clean_s=clean_s, forced_s=forced_s, say=say
    )
