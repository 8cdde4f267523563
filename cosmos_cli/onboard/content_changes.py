"""
Makes and removes what is known by the hash of its content.

So that a power failure at any point leaves what was, or what was wanted. Apart from `content_store`, as a look
changes nothing and need not wait for ctypes and shutil: 4 ms, on a computer that is no board.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import shutil
import time
from collections.abc import Mapping

from cosmos_cli.onboard import content_store
from cosmos_cli.onboard.request_loop import PlainValue, sync_folder

RANDOM_BYTES = 4


def beside(folder: str, name: str) -> str:
    """Return the path of something half made that will be *name*."""
    return os.path.join(
        folder, f"{content_store.HIDDEN}{name}.{os.getpid()}-{os.urandom(RANDOM_BYTES).hex()}"
    )


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
    write_whole(os.path.join(folder, content_store.MARK), json.dumps(document).encode())


def write_new(path: str, content: bytes, mode: int) -> None:
    """Write a file that is not there yet."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, mode)
    with open(descriptor, "wb") as file:
        file.write(content)


def remove(path: str) -> None:
    """Remove a folder or file; it loses its name at once, and what it holds by and by."""
    folder, name = os.path.split(path)
    gone = beside(folder, name)
    try:
        os.rename(path, gone)
    except FileNotFoundError:
        return
    _remove_now(gone)


def remove_left_overs(folder: str) -> None:
    """
    Remove what was left half made, or half removed, by makers that are gone.

    What a clock that was ahead has stamped with a time to come begins to grow old now.
    """
    for name in content_store.left_overs(folder):
        with contextlib.suppress(OSError):
            _remove_now(os.path.join(folder, name))
    soon_s = time.clock_gettime(time.CLOCK_REALTIME) + content_store.LEFT_OVER_S
    for name, changed_s in content_store.changes_of_hidden(folder).items():
        if changed_s > soon_s:
            with contextlib.suppress(OSError):
                os.utime(os.path.join(folder, name), follow_symlinks=False)


def _remove_now(path: str) -> None:
    if os.path.isdir(path) and not os.path.islink(path):
        shutil.rmtree(path)
    else:
        os.unlink(path)
