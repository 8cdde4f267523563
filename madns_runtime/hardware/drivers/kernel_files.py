"""Files by which the kernel tells and takes one value each, as text."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from madns_runtime.errors import MachineError

TEXT_BYTES_MAX = 64
REFUSALS = (errno.EINVAL, errno.ERANGE, errno.EDOM, errno.EOVERFLOW)
"""Errors by which a driver of the kernel says that it takes no such value."""


class ValueRefused(MachineError):
    """The kernel's driver is there, and does not take this value."""


def read_text(path: Path) -> str:
    """
    Return what a file of the kernel says.

    Raises:
        MachineError: It cannot be read.
    """
    try:
        with path.open("rb", buffering=0) as file:
            return (file.read(TEXT_BYTES_MAX) or b"").decode("ascii", "replace").strip()
    except OSError as error:
        raise MachineError(f"{path}: {error.strerror}") from None


def read_number(path: Path) -> float:
    """
    Return the number that a file of the kernel says.

    Raises:
        MachineError: It cannot be read, or says none.
    """
    text = read_text(path)
    try:
        return float(text)
    except ValueError:
        raise MachineError(f"{path}: expected a number, got {text!r}") from None


def write_text(path: Path, text: str) -> None:
    """
    Write to a file of the kernel.

    Raises:
        ValueRefused: Its driver takes no such value.
        MachineError: It does not take it for another reason.
    """
    try:
        # Not made where it is missing: what is not there has been unplugged.
        fd = os.open(path, os.O_WRONLY | os.O_TRUNC | os.O_CLOEXEC)
        try:
            os.write(fd, text.encode())
        finally:
            os.close(fd)
    except OSError as error:
        kind = ValueRefused if error.errno in REFUSALS else MachineError
        raise kind(f"{path}: does not take {text!r:.80}: {error.strerror}") from None
