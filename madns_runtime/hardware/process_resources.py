"""Resources that a device's driver may use up: descriptors and memory of its process."""

from __future__ import annotations

import errno
import os
import resource
from typing import Final

PAGE_BYTES: Final = resource.getpagesize()
GROWTH_BYTES_MAX: Final = 256 << 20
"""Memory that a device's process may take beyond what it had when the device was opened first."""


def has_descriptors() -> bool:
    """Tell whether this process may open another file."""
    try:
        os.close(os.dup(0))
    except OSError as error:
        return error.errno not in (errno.EMFILE, errno.ENFILE)
    return True


def resident_bytes() -> int:
    """Return the memory that this process has; 0 where the system does not tell (not Linux, or no descriptor left)."""
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * PAGE_BYTES
    except (OSError, IndexError, ValueError):
        return 0


def leak_of(first_bytes: int) -> str:
    """
    Return in words what this process has taken beyond what is borne; empty if it is less, or nobody knows.

    Args:
        first_bytes: What it had when the device was opened first; 0 if that is not known.
    """
    grown_bytes = resident_bytes() - first_bytes
    if not first_bytes or grown_bytes <= GROWTH_BYTES_MAX:
        return ""
    return f"leaks memory: {grown_bytes >> 20} MiB since it was opened"
