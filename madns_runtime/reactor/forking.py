"""Clean-up in a forked child of what it got from its parent."""

from __future__ import annotations

import gc
import os
import signal


def leave_parent(keep: set[int]) -> None:
    """
    Make a forked child independent of its parent's descriptors, but those of *keep*, and of its signals.

    What the parent had is not collected here: a socket of its garbage would close a number that is this process's by then.
    """
    gc.freeze()
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    null_fd = os.open(os.devnull, os.O_RDWR)
    os.dup2(null_fd, 0)
    first = 3
    for fd in (*sorted(keep), 1 << 20):
        os.closerange(first, fd)
        first = fd + 1
