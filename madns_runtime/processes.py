"""
The machine's register of running processes: one small file each, believed only as far as the kernel agrees.

A pid alone says nothing, for the kernel gives it out again: an entry holds the start time and the boot
as well, and a process is signalled through a descriptor that cannot come to mean another. Standard
library only: the operator's side sends this source to machines that have nothing of COSMoS installed.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import platform
import re
import signal
import stat
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

Role = Literal["operator", "host", "supervisor", "agent"]

FILE_BYTES_MAX = 16_384
ENVIRONMENT_BYTES_MAX = 8 * 1024**2
"""No kernel takes a larger one, as the stack is limited by default."""
NAME_CHARACTERS_MAX = 200
"""Characters entered of the name of a process of many agents, which lists them all."""
NOT_THERE = (FileNotFoundError, ProcessLookupError, PermissionError)
"""Errors by which /proc tells that a process has ended, or that its number is another user's now, whom it may hide."""
SHORTAGES = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Errors by which a file that is there cannot be read for now."""
_FILE_NAME = re.compile(r"\.?(\d+)-(\d+)-\d+\.json")
_serials = itertools.count()


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessEntry:
    """One process of a run on this machine."""

    run: str
    role: Role
    name: str
    pid: int
    start_ticks: int
    """Start in clock ticks since boot (field 22 of /proc/<pid>/stat)."""
    boot_id: str
    node: str
    """The machine's own name: a home directory may be shared by many."""
    run_directory: str
    utc: str


class Registration:
    """An entry of this process; `remove` it at the end, or use it as a context manager. Redo it after a fork."""

    def __init__(self, entry: ProcessEntry, path: Path | None, problem: str | None) -> None:
        self.entry = entry
        self.problem = problem
        """Why the entry could not be written; None if it was."""
        self._path = path

    def remove(self) -> None:
        """Take the entry out; in a forked process, whose entry it is not, do nothing."""
        if self._path is not None and os.getpid() == self.entry.pid:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)
            self._path = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.remove()


def state_directory() -> Path:
    """Return where the register is: COSMOS_STATE_DIR, XDG_STATE_HOME/cosmos or ~/.local/state/cosmos, processes."""
    own = os.environ.get("COSMOS_STATE_DIR")
    if own:
        return Path(os.path.expanduser(own)) / "processes"
    shared = os.environ.get("XDG_STATE_HOME")
    home = os.path.expanduser("~")
    if home == "~":  # as of a number for which nobody stands; containers give such a one this home
        home = "/"
    base = Path(shared) if shared else Path(home) / ".local/state"
    return base / "cosmos/processes"


def register(run: str, role: Role, name: str, run_directory: str | Path) -> Registration:
    """
    Enter this process into the machine's register.

    A directory that cannot be written is no reason to fail: `Registration.problem` says so.

    Args:
        run: Name of the run.
        role: operator, host, supervisor or agent.
        name: host, the machine's or the agent's name; of several agents all, with commas, entered
            shortened if they are many.
        run_directory: Where the run's evidence goes.
    """
    pid = os.getpid()
    unknown: OSError | None = None
    start_ticks, boot_id = 0, ""
    try:
        start_ticks, boot_id = read_start_ticks(pid) or 0, read_boot_id()
    except OSError as error:
        unknown = error  # An entry without them would count as a dead process's.
    entry = ProcessEntry(
        run=run,
        role=role,
        name=_shortened(name),
        pid=pid,
        start_ticks=start_ticks,
        boot_id=boot_id,
        node=platform.node(),
        run_directory=str(run_directory),
        utc=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    directory = state_directory()
    path = directory / f"{pid}-{entry.start_ticks}-{next(_serials)}.json"
    try:
        if unknown is not None:
            raise unknown
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        _write_whole(path, json.dumps(asdict(entry)).encode())
    except OSError as error:
        problem = (
            f"{directory}: cannot note process {pid} ({role} {entry.name}) there: {error.strerror}; "
            "`cosmos ps` and `cosmos down` will not see it; COSMOS_STATE_DIR names another place"
        )
        return Registration(entry, None, problem)
    return Registration(entry, path, None)


def list_processes() -> list[ProcessEntry]:
    """
    Return the living processes of the register, by run, role and name; entries of dead ones are removed.

    Raises:
        OSError: It cannot be told who lives, as where descriptors or memory have run out.
    """
    entries = [entry for path in _files() if (entry := _check(path)) is not None]
    return sorted(entries, key=lambda entry: (entry.run, entry.role, entry.name, entry.pid))


def is_running(entry: ProcessEntry) -> bool:
    """
    Return whether the entry's process lives: same pid, same start, same boot.

    Raises:
        OSError: The kernel cannot be asked.
    """
    return entry.boot_id == read_boot_id() and read_start_ticks(entry.pid) == entry.start_ticks


def end_process(entry: ProcessEntry, number: int = signal.SIGTERM) -> bool:
    """
    Signal the entry's process, if it is still the one that was entered.

    Returns:
        False if it had ended already.

    Raises:
        PermissionError: It belongs to another user.
        OSError: The kernel cannot be asked whether it is that one; it was not signalled.
    """
    if not hasattr(os, "pidfd_open"):
        return is_running(entry) and _signal(entry.pid, number)
    try:
        descriptor = os.pidfd_open(entry.pid)
    except ProcessLookupError:
        return False
    except OSError:  # An old kernel, a sandbox without the call, or no descriptor left.
        return is_running(entry) and _signal(entry.pid, number)
    try:
        # Verified after the descriptor was opened: from here on it means this process and no other.
        if not is_running(entry):
            return False
        signal.pidfd_send_signal(descriptor, number)
    except ProcessLookupError:
        return False
    finally:
        os.close(descriptor)
    return True


def read_environment(pid: int) -> list[bytes]:
    """
    Return the variables of a process's environment, NAME=VALUE each.

    Raises:
        OSError: It is another user's, or has ended.
    """
    with open(f"/proc/{pid}/environ", "rb") as file:
        return file.read(ENVIRONMENT_BYTES_MAX).split(b"\0")


def read_start_ticks(pid: int) -> int | None:
    """
    Return when a process started, in clock ticks since boot; None if it has ended (a zombie has).

    Raises:
        OSError: The kernel cannot be asked, as where descriptors or memory have run out: the process may live.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_bytes()
    except NOT_THERE:
        return None
    # The name, in parentheses, may hold spaces and parentheses; state is the field after it, the third.
    values = text[text.rfind(b")") + 1 :].split()
    if len(values) < 20 or values[0] in (b"Z", b"X", b"x"):
        return None
    return int(values[19])


def own_age_s() -> float:
    """Return how long ago this process started, s; 0 where the kernel does not say."""
    try:
        ticks = read_start_ticks(os.getpid())
    except OSError:
        ticks = None
    if ticks is None:
        return 0.0
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))


def read_boot_id() -> str:
    """
    Return what names this boot of the machine; empty where the kernel does not say.

    Raises:
        OSError: It cannot be asked, as where descriptors or memory have run out.
    """
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except NOT_THERE:
        return ""


def _shortened(name: str) -> str:
    """Return of a long list its first and last and how many there are: an entry must stay readable."""
    if len(name) <= NAME_CHARACTERS_MAX:
        return name
    names = name.split(",")
    if len(names) == 1:
        return f"{name[:NAME_CHARACTERS_MAX]} ..."
    room = NAME_CHARACTERS_MAX // 3
    return f"{names[0][:room]} ... {names[-1][-room:]} ({len(names)})"


def _signal(pid: int, number: int) -> bool:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def _write_whole(path: Path, text: bytes) -> None:
    """Write a file that is there in full or not at all; never through a link that lies in its place."""
    draft = path.with_name(f".{path.name}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    with contextlib.suppress(FileNotFoundError):
        draft.unlink()
    try:
        with open(os.open(draft, flags, 0o600), "wb") as file:
            file.write(text)
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        raise


def _files() -> Iterator[Path]:
    try:
        paths = sorted(state_directory().iterdir())
    except (*NOT_THERE, NotADirectoryError):
        return
    yield from (path for path in paths if _FILE_NAME.fullmatch(path.name))


def _check(path: Path) -> ProcessEntry | None:
    """Return the entry of a living process; remove the file of one that is known to be dead."""
    match = _FILE_NAME.fullmatch(path.name)
    if match is None:
        return None
    entry = _read_entry(path)
    if entry is not None and (entry.pid, entry.start_ticks) != (int(match[1]), int(match[2])):
        entry = None  # Not written by the process that the file is named after.
    if entry is not None and entry.node != platform.node():
        return None  # Of another machine that shares this directory: not ours to judge.
    # One that does not see itself, where /proc is not mounted, cannot tell who lives.
    if read_start_ticks(os.getpid()) is None:
        return None if path.name.startswith(".") else entry
    is_dead = read_start_ticks(int(match[1])) != int(match[2])
    if is_dead or (entry is not None and not is_running(entry)):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        return None
    return None if path.name.startswith(".") else entry


def _read_entry(path: Path) -> ProcessEntry | None:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            found = os.fstat(file.fileno())
            if found.st_uid != os.geteuid() or not stat.S_ISREG(found.st_mode):
                return None  # What another user wrote must not tell us whom to signal.
            values = json.loads(file.read(FILE_BYTES_MAX))
    except (ValueError, RecursionError):
        return None
    except OSError as error:
        if error.errno in SHORTAGES:
            raise
        return None
    if not isinstance(values, dict):
        return None
    wanted = {
        field.name: int if field.name in ("pid", "start_ticks") else str
        for field in fields(ProcessEntry)
    }
    if not all(isinstance(values.get(name), kind) for name, kind in wanted.items()):
        return None
    return ProcessEntry(**{name: values[name] for name in wanted})
