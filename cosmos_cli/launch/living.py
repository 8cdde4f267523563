"""What lives of runs on this machine, and ending a run from outside: only what it started, verified."""

from __future__ import annotations

import dataclasses
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosmos_cli.launch.groups import living_members
from madns_runtime.processes import (
    ProcessEntry,
    end_process,
    is_running,
    list_processes,
    read_start_ticks,
)

CHECK_INTERVAL_S = 0.1
ROLE_ORDER = ("operator", "host", "supervisor", "agent")


@dataclass(frozen=True, slots=True, kw_only=True)
class LivingRun:
    """One run of which at least one process lives on this machine."""

    run: str
    directory: str
    processes: tuple[ProcessEntry, ...]

    def of_role(self, *roles: str) -> tuple[ProcessEntry, ...]:
        """Return the processes in these roles."""
        return tuple(entry for entry in self.processes if entry.role in roles)

    def is_called(self, which: str) -> bool:
        """Tell whether *which* is this run's name, number or directory."""
        if os.sep in which:
            return Path(which).resolve() == Path(self.directory).resolve()
        number = self.run.split("-", 1)[0]
        is_number = which.isdecimal() and number.isdecimal() and int(which) == int(number)
        return which == self.run or is_number


def living_runs() -> list[LivingRun]:
    """Return every living run on this machine, by name."""
    runs: dict[tuple[str, str], list[ProcessEntry]] = {}
    for entry in list_processes():
        runs.setdefault((entry.run, run_directory(entry)), []).append(entry)
    return [
        LivingRun(
            run=run,
            directory=directory,
            processes=tuple(
                sorted(entries, key=lambda e: (ROLE_ORDER.index(e.role), e.name, e.pid))
            ),
        )
        for (run, directory), entries in sorted(runs.items())
    ]


def run_directory(entry: ProcessEntry) -> str:
    """Return the run's directory; the host registers its own folder below it."""
    path = Path(entry.run_directory)
    return str(path.parent if entry.role == "host" and path.name == "host" else path)


def age_s(entry: ProcessEntry) -> float:
    """Return how long a process has lived, s; wall time, which may be set, has no say in it."""
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    return max(0.0, time.clock_gettime(clock) - entry.start_ticks / os.sysconf("SC_CLK_TCK"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """What ending a run came to."""

    run: str
    ended: tuple[ProcessEntry, ...]
    killed: tuple[ProcessEntry, ...]
    """Those of *ended* that needed SIGKILL."""
    left: tuple[ProcessEntry, ...]


def end_run(
    run: LivingRun, *, clean_s: float, forced_s: float, say: Callable[[str], None]
) -> Ending:
    """
    End a run: its operator is asked first and shuts down cleanly; then its parts; then SIGKILL.

    Args:
        run: What to end.
        clean_s: Time for a clean shutdown, s.
        forced_s: Time for each of the harder means, s.
        say: Told what is being done.
    """
    known = _with_groups(run.processes)
    operator = run.of_role("operator")
    if operator:
        say(f"{run.run}: asking its operator (pid {operator[0].pid}) to stop")
        _signal(operator, signal.SIGTERM)
        _wait(known, clean_s)
    known = _with_groups(known)
    parts = [e for e in _living(known) if e.role in ("host", "supervisor") and not _is_worker(e)]
    if parts:
        say(f"{run.run}: asking {_names(parts)} to stop")
        _signal(parts, signal.SIGTERM)
        _wait(known, clean_s if not operator else forced_s)
    known = _with_groups(known)
    killed = _living(known)
    if killed:
        say(f"{run.run}: killing {_names(killed)}")
        _signal(killed, signal.SIGKILL)
        _wait(killed, forced_s)
    left = tuple(_living(known))
    return Ending(
        run=run.run,
        ended=tuple(entry for entry in known if entry not in left),
        killed=tuple(entry for entry in killed if entry not in left),
        left=left,
    )


def _with_groups(entries: Sequence[ProcessEntry]) -> tuple[ProcessEntry, ...]:
    """
    Add what is not in the register: workers and samplers in the process groups of host and supervisors.

    Only a living session leader's group is looked at: that group is the run's own, and no number of a
    dead one can have been given out again.
    """
    found = {entry.pid: entry for entry in entries}
    for entry in entries:
        if entry.role in ("host", "supervisor") and is_running(entry) and _leads_session(entry.pid):
            for pid in living_members(entry.pid):
                start_ticks = read_start_ticks(pid)
                if start_ticks is not None and pid not in found:
                    name = f"{entry.name}'s worker"
                    found[pid] = dataclasses.replace(
                        entry, pid=pid, start_ticks=start_ticks, name=name
                    )
    return tuple(found.values())


def _is_worker(entry: ProcessEntry) -> bool:
    return entry.name.endswith("'s worker")


def _leads_session(pid: int) -> bool:
    try:
        return os.getsid(pid) == pid
    except (ProcessLookupError, PermissionError):
        return False


def _signal(entries: Sequence[ProcessEntry], number: signal.Signals) -> None:
    for entry in entries:
        try:
            end_process(entry, number)
        except PermissionError:
            continue  # it stays among those that are left


def _living(entries: Sequence[ProcessEntry]) -> list[ProcessEntry]:
    return [entry for entry in entries if is_running(entry)]


def _wait(entries: Sequence[ProcessEntry], timeout_s: float) -> None:
    until_s = time.monotonic() + timeout_s
    while _living(entries) and time.monotonic() < until_s:
        time.sleep(CHECK_INTERVAL_S)


def _names(entries: Sequence[ProcessEntry], shown_max: int = 5) -> str:
    shown = [f"{entry.name} (pid {entry.pid})" for entry in entries[:shown_max]]
    more = len(entries) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
