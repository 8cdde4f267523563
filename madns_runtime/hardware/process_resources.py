"""What a device's driver may use up: descriptors and memory of its process."""

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
