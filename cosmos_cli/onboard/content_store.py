"""
Content known by its hash on a machine: trees, wheels, environments. Only looks, for speed.

Whatever has a name of its own there is whole: it was made beside or under its name, reached the disk, and
got its name or its mark last (`cosmos_cli.onboard.content_changes`).
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping

from cosmos_cli.onboard.request_loop import PlainValue, sha256

MARK = ".complete"
HIDDEN = "."
"""First character of things half made, or on their way out; nothing else may have it."""
BLOBS = ".blobs"
"""In the folder of trees: files that were sent and belong to no tree yet, by their hash."""
LEFT_OVER_S = 3600.0
"""A half-made thing that nobody has touched for so long has no maker any more."""
NOT_SEEN = (FileNotFoundError, ProcessLookupError, PermissionError)
"""Errors by which /proc tells that a process has ended, or is another user's."""
_BEGAN_S = time.clock_gettime(time.CLOCK_REALTIME) - time.clock_gettime(time.CLOCK_BOOTTIME)
"""When the machine was started, by the wall clock as this process found it."""


def expand(path: str) -> str:
    """Return an absolute path; ~ is the home of who works here."""
    return os.path.abspath(os.path.expanduser(path))


def hash_of(path: str) -> str:
    """Return the SHA-256 of a file."""
    with open(path, "rb", buffering=0) as file:
        return sha256(file)


def read_mark(folder: str) -> dict[str, PlainValue] | None:
    """Return what a folder's mark says; None when it is not whole."""
    try:
        with open(os.path.join(folder, MARK), "rb") as file:
            document = json.loads(file.read())
    except (OSError, ValueError):
        return None
    return document if isinstance(document, dict) else None


def trace(folder: str, names: Iterable[str]) -> dict[str, list[int]]:
    """Return size, time and mode of files and links: what changes when somebody writes to one."""
    found = {}
    for name in names:
        status = os.lstat(f"{folder}/{name}")
        found[name] = [status.st_size, status.st_mtime_ns, status.st_mode]
    return found


def is_untouched(folder: str, files: Mapping[str, list[int]]) -> bool:
    """Tell whether files still are as `trace` found them; others do not matter."""
    try:
        return trace(folder, files) == files
    except (OSError, ValueError, TypeError):
        return False


def files_below(folder: str, left_out: str) -> Iterator[str]:
    """Yield the path of every file and link below a folder, but for its mark and what is in folders named *left_out*."""
    waiting = [""]
    while waiting:
        inner = waiting.pop()
        for entry in os.scandir(os.path.join(folder, inner)):
            if not entry.is_dir(follow_symlinks=False):
                if inner or entry.name != MARK:
                    yield f"{inner}{entry.name}"
            elif entry.name != left_out:
                waiting.append(f"{inner}{entry.name}/")


def names_in(folder: str) -> list[str]:
    """Return the names of all whole things in a folder, or what looks like them."""
    try:
        return sorted(name for name in os.listdir(folder) if not name.startswith(HIDDEN))
    except FileNotFoundError:
        return []


def left_overs(folder: str) -> list[str]:
    """
    Return the names of what was left half made, or half removed, in a folder by makers that are gone.

    A wall clock that is set meanwhile, as by a time service on a board without a clock of its own, makes nothing old
    that is not: it counts as old only by the clock of now and by the one that this process found as it began.
    """
    elapsed_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    now_s = min(_BEGAN_S + elapsed_s, time.clock_gettime(time.CLOCK_REALTIME))
    changed_s = changes_of_hidden(folder).items()
    return sorted(name for name, when_s in changed_s if now_s - when_s > LEFT_OVER_S)


def changes_of_hidden(folder: str) -> dict[str, float]:
    """Return when each thing half made in a folder was changed last, s since 1970, by its name."""
    found = {}
    with contextlib.suppress(FileNotFoundError):
        for name in os.listdir(folder):
            if name.startswith(HIDDEN):
                with contextlib.suppress(OSError):
                    found[name] = os.lstat(os.path.join(folder, name)).st_mtime
    return found


def used(paths: Iterable[str]) -> set[str]:
    """Return those of these paths that a living process was started with."""
    wanted = {path: os.fsencode(path) for path in paths}
    found: set[str] = set()
    for text in _starts() if wanted else ():
        found |= {path for path, needle in wanted.items() if needle in text}
    return found


def _starts() -> Iterator[bytes]:
    """Yield the command line and the environment of every process that lets us see them."""
    own = str(os.getpid())
    for name in os.listdir("/proc"):
        if not name.isdecimal() or name == own:
            continue
        for what in ("cmdline", "environ"):
            # Out of descriptors, say, nobody's start is known: that is an error, not nobody's use.
            with contextlib.suppress(*NOT_SEEN), open(f"/proc/{name}/{what}", "rb") as file:
                yield file.read()
