"""The end of a serial line, as the kernel tells it of a descriptor."""

from __future__ import annotations

import select


def is_hung_up(fd: int) -> bool:
    """Tell whether nothing more can come: the adapter was pulled out, or the other end is closed."""
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll(0))
