"""
The processes of a run on one machine: which live, and their end. Only what the run started, verified.

A run's processes are those of the register, and those that carry its mark in their environment: workers
and samplers are in no register, and outlive a leader that was killed. The register may lack an entry, as on a
full disk: whoever writes into the run's directory is alive all the same.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from cosmos_cli.onboard.request_loop import HelperRefusal, VerbRequest, no_links, verb
from madns_runtime.processes import (
    NOT_THERE,
    ProcessEntry,
    end_process,
    is_running,
    list_processes,
    read_boot_id,
    read_environment,
    read_start_ticks,
)

MARK = "COSMOS_RUN_DIRECTORY"
"""Environment variable of everything that a run starts: its directory on that machine."""
WORKER_SUFFIX = "'s worker"
CHECK_INTERVAL_S = 0.1
HOST_LEAD_S = 0.5
"""A host that is told first tells its agents; told by them, it would take them for lost."""
NAMES_SHOWN_MAX = 5
POLL_S = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEnding:
    """Result of ending a run on one machine."""

    run: str
    ended: tuple[ProcessEntry, ...] = ()
    killed: tuple[ProcessEntry, ...] = ()
    """Those of *ended* that needed SIGKILL."""
    left: tuple[ProcessEntry, ...] = ()

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Self:
        """Read back what `to_mapping` wrote."""
        entries = {
            name: tuple(ProcessEntry(**entry) for entry in mapping[name])
            for name in ("ended", "killed", "left")
        }
        return cls(run=mapping["run"], **entries)


@verb("processes")
def processes(request: VerbRequest) -> list[dict[str, Any]]:
    """
    List the living processes of the register.

    "state" is COSMOS_STATE_DIR of what runs here. With "ages" each has "age_s" as well: the clocks of
    two machines may differ.
    """
    entries = read_register(path_of(request, "state"))
    if not request.arguments.get("ages"):
        return [asdict(entry) for entry in entries]
    return [{**asdict(entry), "age_s": round(age_s(entry), 1)} for entry in entries]


@verb("end_run")
def end_run(request: VerbRequest) -> dict[str, Any]:
    """
    End what lives of one run here: "directory" is its directory on this machine, "state" the register's.

    "clean_s" is the time for a clean shutdown, "forced_s" for what SIGKILL has to end.
    """
    directory = path_of(request, "directory")
    real = os.path.realpath(directory)
    register = read_register(path_of(request, "state"))
    entries = [e for e in register if os.path.realpath(run_directory(e)) == real]
    return end_entries(
        entries,
        directory=directory,
        clean_s=float(request.arguments["clean_s"]),
        forced_s=float(request.arguments["forced_s"]),
    ).to_mapping()


@verb("group")
def group(request: VerbRequest) -> list[int]:
    """Return who of a process group of the run in "directory" lives: "group" is its leader's number."""
    number = int(request.arguments["group"])
    marked = started_with(MARK, path_of(request, "directory"))
    return sorted(pid for pid in marked if _told(os.getpgid, pid) == number)


@verb("signal_group")
def signal_group(request: VerbRequest) -> list[int]:
    """Send the signal number "signal" to a group, as `group` finds it, and return who got it."""
    members: list[int] = group(request)
    for pid in members:
        # Two processes of a group may end between looking and signalling; no other run's is meant.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, int(request.arguments["signal"]))
    return members


@verb("living")
def living(request: VerbRequest) -> list[str]:
    """Return in words what of the run in a directory lives."""
    return find_living(path_of(request, "directory"), path_of(request, "state"))


def path_of(request: VerbRequest, name: str) -> str:
    """Return a path that the request names, with ~ resolved."""
    return os.path.expanduser(str(request.arguments[name]))


def wait_for_end(directory: str, state: str, patience_s: float) -> None:
    """
    Wait until nothing of the run in a directory lives.

    Raises:
        Refusal: Something does after *patience_s*.
    """
    until_s = time.monotonic() + patience_s
    while found := find_living(directory, state):
        if time.monotonic() >= until_s:
            raise HelperRefusal(
                "busy",
                f"still running there: {first_few(found)}",
                "wait for its end, or end it with: cosmos down",
            )
        time.sleep(POLL_S)


def find_living(directory: str, state: str) -> list[str]:
    """Return in words what lives of the run in a directory: by the register, or because it writes there."""
    inside = os.path.realpath(directory)
    entries = {
        entry.pid: words_of(entry)
        for entry in read_register(state)
        if is_within(os.path.realpath(entry.run_directory), inside)
    }
    return [*entries.values(), *(text for pid, text in _writers(inside) if pid not in entries)]


@verb("last_words")
def last_words(request: VerbRequest) -> list[str]:
    """Return the last lines of the file "path", at most "lines" of them."""
    try:
        with open(path_of(request, "path"), "rb", opener=no_links) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - int(request.arguments["bytes"])))
            text = file.read(int(request.arguments["bytes"])).decode(errors="replace")
    except OSError:
        return []
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-int(request.arguments["lines"]) :]


def read_register(state: str) -> list[ProcessEntry]:
    """Return the living processes of all runs on this machine."""
    os.environ["COSMOS_STATE_DIR"] = state
    return list_processes()


def words_of(entry: ProcessEntry) -> str:
    """Return a process as a person is told of it."""
    name = entry.name if entry.name == entry.role else f"{entry.role} {entry.name}"
    return f"{name} (pid {entry.pid})"


def is_within(path: str, directory: str) -> bool:
    """Tell whether a path is a directory or below it; both are resolved."""
    return path == directory or path.startswith(directory.rstrip("/") + "/")


def run_directory(entry: ProcessEntry) -> str:
    """Return the run's directory; the host may register its own folder below it."""
    path = Path(entry.run_directory)
    return str(path.parent if entry.role == "host" and path.name == "host" else path)


def age_s(entry: ProcessEntry) -> float:
    """Return how long a process has lived, s; wall time, which may be set, has no say in it."""
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    return max(0.0, time.clock_gettime(clock) - entry.start_ticks / os.sysconf("SC_CLK_TCK"))


def end_entries(
    entries: Sequence[ProcessEntry],
    *,
    directory: str,
    clean_s: float,
    forced_s: float,
    say: Callable[[str], None] = lambda text: None,
) -> RunEnding:
    """
    End a run: its operator is asked first and shuts down cleanly; then its parts; then SIGKILL.

    Args:
        entries: Of the register; there may be none although marked processes live.
        directory: The run's, here.
        clean_s: Time for a clean shutdown, s.
        forced_s: Time for each of the harder means, s.
        say: Told what is being done.
    """
    known = _with_workers(entries, directory)
    run = known[0].run if known else Path(directory).name
    operator = [entry for entry in known if entry.role == "operator"]
    if operator:
        say(f"{run}: asking its operator (pid {operator[0].pid}) to stop")
        _signal(operator, signal.SIGTERM)
        _wait(known, clean_s)
    known = _with_workers(known, directory)
    left = [entry for entry in _living(known) if not is_worker(entry)]
    parts = [entry for entry in left if entry.role in ("host", "supervisor")]
    if not parts and not operator:
        parts = left  # agents whose supervisor is gone
    if parts:
        say(f"{run}: asking {names_of(parts)} to stop")
        host = [entry for entry in parts if entry.role == "host"]
        _signal(host, signal.SIGTERM)
        _wait(host, HOST_LEAD_S)
        _signal(parts, signal.SIGTERM)
        # An operator that did not heed is waited for no more; these hear of the end only now.
        followers = [entry for entry in known if entry not in operator]
        _wait(followers, max(clean_s, forced_s) if operator else clean_s)
    known = _with_workers(known, directory)
    killed = _living(known)
    if killed:
        say(f"{run}: killing {names_of(killed)}")
        _signal(killed, signal.SIGKILL)
        _wait(killed, forced_s)
    left = _living(known)
    return RunEnding(
        run=run,
        ended=tuple(entry for entry in known if entry not in left),
        killed=tuple(entry for entry in killed if entry not in left),
        left=tuple(left),
    )


def is_worker(entry: ProcessEntry) -> bool:
    """Tell whether an entry stands for a process that is in no register."""
    return entry.name.endswith(WORKER_SUFFIX)


def names_of(entries: Sequence[ProcessEntry]) -> str:
    """Return the first few by name and number, and how many more there are."""
    return first_few([f"{entry.name} (pid {entry.pid})" for entry in entries])


def first_few(names: Sequence[str]) -> str:
    """Return the first of some names, and how many more there are."""
    rest = len(names) - NAMES_SHOWN_MAX
    return ", ".join(names[:NAMES_SHOWN_MAX]) + (f" and {rest} more" if rest > 0 else "")


def _with_workers(entries: Sequence[ProcessEntry], directory: str) -> tuple[ProcessEntry, ...]:
    """
    Add what is not in the register: the marked, and the groups of host and supervisors.

    Of groups without a mark only a living session leader's is looked at: that group is the run's own,
    and no number of a dead one can have been given out again.
    """
    found = {entry.pid: entry for entry in entries}
    for entry in entries:
        if (
            entry.role in ("host", "supervisor")
            and is_running(entry)
            and _told(os.getsid, entry.pid) == entry.pid
        ):
            for pid in process_numbers():
                if pid not in found and _told(os.getpgid, pid) == entry.pid:
                    _add_worker(found, pid, entry)
    pattern = _pattern(entries, directory)
    for pid in started_with(MARK, directory):
        if pid not in found:
            _add_worker(found, pid, found.get(_told(os.getpgid, pid) or 0, pattern))
    return tuple(found.values())


def _pattern(entries: Sequence[ProcessEntry], directory: str) -> ProcessEntry:
    """Return what the entry of a worker is made of when its leader is not known."""
    run = entries[0].run if entries else Path(directory).name
    return ProcessEntry(
        run=run,
        role="agent",
        name=run,
        pid=0,
        start_ticks=0,
        boot_id=read_boot_id(),
        node=os.uname().nodename,
        run_directory=directory,
        utc="",
    )


def _add_worker(found: dict[int, ProcessEntry], pid: int, leader: ProcessEntry) -> None:
    start_ticks = read_start_ticks(pid)
    if start_ticks is not None:
        name = leader.name if is_worker(leader) else f"{leader.name}{WORKER_SUFFIX}"
        found[pid] = dataclasses.replace(leader, pid=pid, start_ticks=start_ticks, name=name)


def process_numbers() -> Iterator[int]:
    """Yield the numbers of all processes here."""
    with os.scandir("/proc") as folders:
        yield from (int(folder.name) for folder in folders if folder.name.isdecimal())


def started_with(variable: str, value: str) -> list[int]:
    """Return the living processes of this user that have a variable in their environment, but not this one."""
    mark = f"{variable}={value}".encode()
    found = []
    for pid in process_numbers():
        try:
            is_marked = mark in read_environment(pid)
        except NOT_THERE:  # another user's, or it has just ended
            continue
        if is_marked and pid != os.getpid() and read_start_ticks(pid) is not None:
            found.append(pid)
    return found


def _writers(directory: str) -> Iterator[tuple[int, str]]:
    """Yield each process of this user that has a file below a directory open for writing."""
    for pid in process_numbers():
        if pid != os.getpid() and (path := _written_by(pid, directory)):
            yield pid, f"pid {pid} writes {os.path.relpath(path, directory)}"


def _written_by(pid: int, directory: str) -> str | None:
    try:
        descriptors = os.listdir(f"/proc/{pid}/fd")
    except NOT_THERE:  # it has ended, or is another user's
        return None
    for descriptor in descriptors:
        try:
            path = os.readlink(f"/proc/{pid}/fd/{descriptor}")
            if not is_within(path, directory):
                continue
            with open(f"/proc/{pid}/fdinfo/{descriptor}", "rb") as info:
                flags = dict(line.split(b":", 1) for line in info if b":" in line)
        except NOT_THERE:  # closed since
            continue
        if int(flags.get(b"flags", b"0"), 8) & os.O_ACCMODE != os.O_RDONLY:
            return path
    return None


def _told(question: Callable[[int], int], pid: int) -> int | None:
    """Ask the kernel about a process; None when it has ended, or is another user's."""
    try:
        return question(pid)
    except (ProcessLookupError, PermissionError):
        return None


def _signal(entries: Sequence[ProcessEntry], number: int) -> None:
    for entry in entries:
        with contextlib.suppress(PermissionError):  # it stays among those that are left
            end_process(entry, number)


def _living(entries: Sequence[ProcessEntry]) -> list[ProcessEntry]:
    return [entry for entry in entries if is_running(entry)]


def _wait(entries: Sequence[ProcessEntry], timeout_s: float) -> None:
    until_s = time.monotonic() + timeout_s
    while _living(entries) and time.monotonic() < until_s:
        time.sleep(CHECK_INTERVAL_S)
