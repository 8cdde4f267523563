"""
Access to a run's records: the modes of its folders and files, whatever the umask was before.

Set as the umask of every process of a run, before it records, so that it also holds for what plug-ins and
flight programs write.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Literal

Access = Literal["private", "group", "all"]
DEFAULT: Access = "private"
UMASKS: Mapping[Access, int] = MappingProxyType({"private": 0o077, "group": 0o027, "all": 0o022})


def umask_of(access: Access | None) -> int:
    """Return the umask that grants this access and no more; of None, that of the default."""
    return UMASKS[access or DEFAULT]


def apply_access(access: Access | None) -> None:
    """Let all that this process and its children write from now on have this access."""
    os.umask(umask_of(access))


@contextlib.contextmanager
def access_applied(access: Access | None) -> Iterator[None]:
    """Let all that is written meanwhile have this access. For one thread at a time: a process has one umask."""
    before = os.umask(umask_of(access))
    try:
        yield
    finally:
        os.umask(before)


def folder_mode(access: Access | None) -> int:
    """Return the mode of a folder: 0o700, 0o750 or 0o755."""
    return 0o777 & ~umask_of(access)


def file_mode(access: Access | None) -> int:
    """Return the mode of a file: 0o600, 0o640 or 0o644."""
    return 0o666 & ~umask_of(access)


def access_of(mode: int) -> Access:
    """Return the access that the mode of a folder grants."""
    if mode & 0o007:
        return "all"
    return "group" if mode & 0o070 else "private"
