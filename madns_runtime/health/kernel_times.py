"""Times that the kernel counts: stolen by the hypervisor, and waited for a processor."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Final

STAT: Final = Path("/proc/stat")
SCHEDSTAT: Final = Path("/proc/thread-self/schedstat")
STEAL_AT: Final = 8
"""Place of the stolen time in the line of all processors (proc(5))."""
TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
READ_BYTES: Final = 4096


def stolen_s(path: Path = STAT) -> float:
    """Return the time since the machine's start that others took from its processors, all together, s; 0 where not told."""
    fields = _read(path).split(b"\n", 1)[0].split()
    return int(fields[STEAL_AT]) / TICKS_PER_S if len(fields) > STEAL_AT else 0.0


def waited_s(path: Path = SCHEDSTAT) -> float:
    """Return for how long the calling thread was ready to run and did not, since its start, s; infinite where not told."""
    fields = _read(path).split()
    return int(fields[1]) * 1e-9 if len(fields) > 1 else math.inf


def _read(path: Path) -> bytes:
    try:
        with open(path, "rb", buffering=0) as file:
            return file.read(READ_BYTES)
    except OSError:
        return b""
