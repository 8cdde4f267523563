"""
What of a run lives on this machine, by two witnesses: the register of processes, and the kernel.

The register may lack an entry, as on a full disk; whoever writes into the run's directory is alive all
the same.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

from cosmos_cli.fleet.onboard.core import Refusal, Request, verb
from madns_runtime.processes import ProcessEntry, list_processes

LIVING_SHOWN_MAX = 5
POLL_S = 0.05


@verb("living")
def living(request: Request) -> list[str]:
    """Return in words what of the run in a directory lives."""
    return find_living(path_of(request, "directory"), path_of(request, "state"))


def path_of(request: Request, name: str) -> str:
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
            rest = len(found) - LIVING_SHOWN_MAX
            more = f" and {rest} more" if rest > 0 else ""
            raise Refusal(
                "busy",
                f"still running there: {', '.join(found[:LIVING_SHOWN_MAX])}{more}",
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


def _writers(directory: str) -> Iterator[tuple[int, str]]:
    """Yield each process of this user that has a file below a directory open for writing."""
    own = os.getpid()
    for pid in (int(name) for name in os.listdir("/proc") if name.isdecimal()):
        if pid != own and (path := _written_by(pid, directory)):
            yield pid, f"pid {pid} writes {os.path.relpath(path, directory)}"


def _written_by(pid: int, directory: str) -> str | None:
    try:
        descriptors = os.listdir(f"/proc/{pid}/fd")
    except OSError:  # it has ended, or is another user's
        return None
    for descriptor in descriptors:
        try:
            path = os.readlink(f"/proc/{pid}/fd/{descriptor}")
            if not is_within(path, directory):
                continue
            with open(f"/proc/{pid}/fdinfo/{descriptor}", "rb") as info:
                flags = dict(line.split(b":", 1) for line in info if b":" in line)
        except OSError:  # closed since
            continue
        if int(flags.get(b"flags", b"0"), 8) & os.O_ACCMODE != os.O_RDONLY:
            return path
    return None
