"""Process groups: who of a group lives, and ending all of it. A zombie has ended and does not count."""

from __future__ import annotations

import contextlib
import os
import signal

import psutil


def living_members(group: int) -> list[int]:
    """Return the processes of *group* that have not ended."""
    return [pid for pid in psutil.pids() if _is_living_member(pid, group)]


def signal_group(group: int, number: signal.Signals) -> None:
    """Send a signal to every process of *group*; one that is empty is left in peace."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(group, number)


def _is_living_member(pid: int, group: int) -> bool:
    try:
        if os.getpgid(pid) != group:
            return False
        return psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except (ProcessLookupError, PermissionError, psutil.Error):
        return False
