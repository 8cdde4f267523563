"""Clean-up in a forked child of what it got from its parent."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from typing import Final, NoReturn

CAME_BACK: Final = (
    "forked a process that came back from the call; let such a process end itself by os._exit(0)"
)
"""Said of a plug-in's method: two processes would go on as the same one."""
_exit = os._exit
"""The true one: a plug-in may put another in its place."""
_generation = 0


def generation() -> int:
    """Return how many forks by Python lie between this process and its first one; costs no system call."""
    return _generation


def _count_fork() -> None:
    global _generation  # noqa: PLW0603 - it is the process's
    _generation += 1


os.register_at_fork(after_in_child=_count_fork)


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


def end_child(code: int) -> NoReturn:
    """End a forked child at once, whatever a plug-in has made of standard error: its parent's code is not its own."""
    try:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
    finally:
        _exit(code)
