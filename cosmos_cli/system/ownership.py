"""
Files of this user: small ones for later (caches and registers), and runs, whose folder may be a shared one.

What another user laid there is not believed: it would say which machine is meant, or what is installed on it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import pwd
import tempfile
from pathlib import Path

from cosmos_cli.errors import InputError
from madns_runtime.bounded_files import open_regular_file

ROOT = 0


def read_own_file(path: Path, *, bytes_max: int) -> bytes:
    """
    Return the content of a regular file of this user, or of root.

    Raises:
        OSError: It is missing, no regular file, another user's, or longer than *bytes_max*.
    """
    with open(open_regular_file(path), "rb") as file:
        if os.fstat(file.fileno()).st_uid not in (os.geteuid(), ROOT):
            raise PermissionError(errno.EPERM, "another user's", str(path))
        data = file.read(bytes_max + 1)
    if len(data) > bytes_max:
        raise OSError(errno.EFBIG, f"expected at most {bytes_max} bytes", str(path))
    return data


def keep_small_file(folder: Path, name: str, text: str, *, count_max: int) -> None:
    """
    Write a file whole or not at all, for this user alone, and forget the oldest of its folder beyond *count_max*.

    Raises:
        OSError: It cannot be written.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    descriptor, partial = tempfile.mkstemp(dir=folder)
    try:
        with open(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(partial, folder / name)
    except BaseException:  # a full disk has room for its name, and another one with each command
        with contextlib.suppress(OSError):
            os.unlink(partial)
        raise
    with contextlib.suppress(OSError):
        kept = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in kept[count_max:]:
            old.unlink(missing_ok=True)


def check_own_folder(descriptor: int, path: Path) -> None:
    """
    See that an open folder may be written into: it is this user's, or this user is root.

    Raises:
        InputError: It is another user's; the message says whose.
    """
    uid = os.fstat(descriptor).st_uid
    if os.geteuid() in (uid, ROOT):
        return
    try:
        owner = pwd.getpwuid(uid).pw_name
    except KeyError:
        owner = f"user {uid}"
    others = "" if uid == ROOT else " or root"
    raise InputError(
        f"{path}: belongs to {owner}: nothing is written there; let {owner}{others} repeat the command"
    )
