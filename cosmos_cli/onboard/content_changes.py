"""
Makes and removes what is known by the hash of its content.

So that a power failure at any point leaves what was, or what was wanted. Apart from `content_store`, as a look
changes nothing and need not wait for ctypes, glob and shutil: 4 ms, on a computer that is no board.
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import json
import os
import shutil
import time
from collections.abc import Mapping

from cosmos_cli.onboard.content_store import HIDDEN, MARK
from cosmos_cli.onboard.request_loop import PlainValue, sync_folder

LEFT_OVER_S = 3600.0
"""A half-made thing that nobody has touched for so long has no maker any more."""
RANDOM_BYTES = 4
_BEGAN_S = time.clock_gettime(time.CLOCK_REALTIME) - time.clock_gettime(time.CLOCK_BOOTTIME)
"""When the machine was started, by the wall clock as this process found it."""


def beside(folder: str, name: str) -> str:
    """Return the path of something half made that will be *name*."""
    return os.path.join(folder, f"{HIDDEN}{name}.{os.getpid()}-{os.urandom(RANDOM_BYTES).hex()}")


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
        sync_folder(folder)


def mark_complete(folder: str, document: Mapping[str, PlainValue]) -> None:
    """Write the mark that says that a folder is whole; what is in it must be on the disk already."""
    write_whole(os.path.join(folder, MARK), json.dumps(document).encode())


def write_new(path: str, content: bytes, mode: int) -> None:
    """Write a file that is not there yet."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, mode)
    with open(descriptor, "wb") as file:
        file.write(content)


def remove(path: str) -> None:
    """Remove a folder; it loses its name at once, and what it holds by and by."""
    folder, name = os.path.split(path)
    gone = beside(folder, name)
    try:
        os.rename(path, gone)
    except FileNotFoundError:
        return
    shutil.rmtree(gone)


def remove_left_overs(folder: str) -> None:
    """
    Remove what was left half made, or half removed, by makers that are gone.

    A wall clock that is set forward meanwhile, as by a time service on a board without a clock of its own, makes
    nothing old that this process has made.
    """
    now_s = _BEGAN_S + time.clock_gettime(time.CLOCK_BOOTTIME)
    for path in glob.glob(os.path.join(glob.escape(folder), f"{HIDDEN}*")):
        with contextlib.suppress(OSError):
            if now_s - os.lstat(path).st_mtime > LEFT_OVER_S:
                shutil.rmtree(path) if os.path.isdir(path) else os.unlink(path)
