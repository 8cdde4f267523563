"""Descriptors of a process: how many it may have open, and which are ready, whatever their numbers: `select` ends at 1023."""

from __future__ import annotations

import contextlib
import math
import resource
import select
from collections.abc import Collection
from typing import Final

READABLE: Final = select.POLLIN | select.POLLPRI
NOT_JUST_WRITABLE: Final = READABLE | select.POLLHUP | select.POLLERR | select.POLLNVAL
NOT_JUST_READABLE: Final = select.POLLOUT | select.POLLHUP | select.POLLERR | select.POLLNVAL


def allow_descriptors(count: int | None = None) -> None:
    """Raise how many files this process may have open to *count*, None for all that the system allows; never lower it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = hard if count is None or count > hard > 0 else count
    if wanted > soft >= 0 or wanted == hard != soft:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def ready(
    reading: Collection[int], writing: Collection[int], timeout_s: float
) -> tuple[set[int], set[int]]:
    """Wait until descriptors are ready, at most so long; return those that can be read and those that can be written."""
    poller = select.poll()
    for fd in {*reading, *writing}:
        wants_read = READABLE if fd in reading else 0
        poller.register(fd, wants_read | (select.POLLOUT if fd in writing else 0))
    found = poller.poll(math.ceil(max(0.0, timeout_s) * 1e3))
    readable = {fd for fd, events in found if fd in reading and events & NOT_JUST_WRITABLE}
    writable = {fd for fd, events in found if fd in writing and events & NOT_JUST_READABLE}
    return readable, writable
