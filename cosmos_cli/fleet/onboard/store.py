"""
What trees, wheels and environments on a machine have in common: marks, durability, who uses them.

Whatever has a name of its own there is whole: it was made beside or under its name, reached the disk, and
got its name or its mark last. So a power failure at any point leaves what was, or what was wanted.
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from typing import Any

MARK = ".complete"
HIDDEN = "."
"""What begins so is half made, or on its way out; nothing else may be."""
READ_BYTES = 1024 * 1024
LEFT_OVER_S = 3600.0
"""A half-made thing that nobody has touched for so long has no maker any more."""


def expand(path: str) -> str:
    """Return an absolute path; ~ is the home of who works here."""
    return os.path.abspath(os.path.expanduser(path))


def hash_of(path: str) -> str:
    """Return the SHA-256 of a file."""
    digest = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        while block := file.read(READ_BYTES):
            digest.update(block)
    return digest.hexdigest()


def beside(folder: str, name: str) -> str:
    """Return the path of something half made that will be *name*."""
    return os.path.join(folder, f"{HIDDEN}{name}.{os.getpid()}-{secrets.token_hex(4)}")


def sync(folder: str) -> None:
    """Wait until everything below a folder is on the disk: one call for thousands of files."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.syncfs(descriptor):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), folder)
    finally:
        os.close(descriptor)


def sync_names(folder: str) -> None:
    """Wait until the names in a folder are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_whole(path: str, content: bytes, *, is_durable: bool = True) -> None:
    """Write a file under its name all at once."""
    folder, name = os.path.split(path)
    partial = beside(folder, name)
    try:
        with open(partial, "xb") as file:
            file.write(content)
            if is_durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(partial)
        raise
    if is_durable:
        sync_names(folder)


def mark_complete(folder: str, document: dict[str, Any]) -> None:
    """Write the mark that says that a folder is whole; what is in it must be on the disk already."""
    write_whole(os.path.join(folder, MARK), json.dumps(document).encode())


def read_mark(folder: str) -> dict[str, Any] | None:
    """Return what a folder's mark says; None when it is not whole."""
    try:
        with open(os.path.join(folder, MARK), "rb") as file:
            document = json.loads(file.read())
    except (OSError, ValueError):
        return None
    return document if isinstance(document, dict) else None


def touch_mark(folder: str) -> None:
    """Remember that a folder is wanted now."""
    with contextlib.suppress(OSError):
        os.utime(os.path.join(folder, MARK))


def remove(path: str) -> None:
    """Remove a folder; it loses its name at once, and what it holds by and by."""
    folder, name = os.path.split(path)
    gone = beside(folder, name)
    try:
        os.rename(path, gone)
    except FileNotFoundError:
        return
    shutil.rmtree(gone)


def names_in(folder: str) -> list[str]:
    """Return the names of all whole things in a folder, or what looks like them."""
    try:
        return sorted(name for name in os.listdir(folder) if not name.startswith(HIDDEN))
    except FileNotFoundError:
        return []


def remove_left_overs(folder: str, now_s: float) -> None:
    """Remove what was left half made, or half removed, by makers that are gone."""
    for path in glob.glob(os.path.join(glob.escape(folder), f"{HIDDEN}*")):
        with contextlib.suppress(OSError):
            if now_s - os.lstat(path).st_mtime > LEFT_OVER_S:
                shutil.rmtree(path) if os.path.isdir(path) else os.unlink(path)


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
            with contextlib.suppress(OSError), open(f"/proc/{name}/{what}", "rb") as file:
                yield file.read()
