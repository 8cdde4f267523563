"""
Locks on files that others may hold as well: waited for until a deadline, and then it is said who holds them.

The kernel drops a lock when its holder dies. Who may open a file may lock it, so that in a shared folder no
lock may be waited for without end.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pwd
import time
from collections.abc import Iterator
from pathlib import Path

POLL_S = 0.05
COMMAND_CHARACTERS_MAX = 100
LOCKS = Path("/proc/locks")


class LockHeld(Exception):
    """Somebody else holds it; the message says who, in words."""


def open_lock(path: Path) -> int:
    """
    Open a file that is there to be locked; what it holds stays, and a link is not followed.

    Raises:
        OSError: It cannot be opened; a link is ELOOP.
    """
    flags = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    return os.open(path, flags, 0o600)


def take_lock(descriptor: int, *, timeout_s: float) -> None:
    """
    Lock an open file, waiting at most *timeout_s*.

    Raises:
        LockHeld: Somebody held it all the time.
    """
    until_s = time.monotonic() + timeout_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= until_s:
                raise LockHeld(holder_of(descriptor)) from None
        time.sleep(POLL_S)


def holder_of(descriptor: int) -> str:
    """Return who holds the lock on an open file, in words; "somebody" where the kernel does not tell."""
    found = os.fstat(descriptor)
    try:
        listed = LOCKS.read_text(encoding="ascii", errors="replace")
    except OSError:
        return "somebody"
    pids = lock_pids(listed, device=found.st_dev, inode=found.st_ino)
    return ", ".join(_words(pid) for pid in pids) or "somebody"


def lock_pids(listed: str, *, device: int, inode: int) -> list[int]:
    """Return who holds a lock on a file by the lines of /proc/locks; those who wait for one have "->" there. Pure."""
    wanted = f"{os.major(device):02x}:{os.minor(device):02x}:{inode}"
    rows = (line.split() for line in listed.splitlines())
    held = (row for row in rows if len(row) >= 6 and row[1] == "FLOCK" and row[5] == wanted)
    return list(dict.fromkeys(int(row[4]) for row in held if row[4].isdecimal()))


def _words(pid: int) -> str:
    words = f"pid {pid}"
    with contextlib.suppress(OSError):
        raw = Path(f"/proc/{pid}/cmdline").read_bytes()[: 4 * COMMAND_CHARACTERS_MAX]
        command = raw.replace(b"\0", b" ").decode(errors="replace").strip()
        shown = "".join(c if c.isprintable() else "?" for c in command)[:COMMAND_CHARACTERS_MAX]
        words += f" ({shown})" if shown else ""
    with contextlib.suppress(OSError, KeyError):
        words += f" of user {pwd.getpwuid(Path(f'/proc/{pid}').stat().st_uid).pw_name}"
    return words


@contextlib.contextmanager
def locked(path: Path, *, timeout_s: float) -> Iterator[None]:
    """
    Hold the lock of a file that is there for nothing else.

    Raises:
        LockHeld: Somebody held it all the time.
        OSError: It cannot be opened.
    """
    descriptor = open_lock(path)
    try:
        take_lock(descriptor, timeout_s=timeout_s)
        yield
    finally:
        os.close(descriptor)
