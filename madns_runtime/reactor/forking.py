"""Clean-up in a forked child of what it got from its parent."""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import sys
from typing import Final, NoReturn
from weakref import WeakSet

from madns_runtime.timing.granted_clock import GrantedLimit

CAME_BACK: Final = (
    "forked a process that came back from the call; let such a process end itself by os._exit(0)"
)
"""Said of a plug-in's method: two processes would go on as the same one."""
LOOK_MS: Final = 50
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


class ForkedCopies:
    """
    The processes that Python forks from this one from now on, as long as they are copies of it.

    Each holds an end of a pipe, which the system closes when it ends or becomes another program. A process that a
    copy forks counts, too. Costs nothing but at a fork.
    """

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._read_fd = self._held_fd = -1
        _watched.add(self)

    def wait_until_gone(self, limit_s: float) -> bool:
        """
        Wait until there is none, and return whether that is so; those forked later are not known.

        Args:
            limit_s: How long to wait, in time in which no process of this one's was kept from a processor.
        """
        if self._read_fd < 0 or os.getpid() != self._pid:
            return True
        os.close(self._held_fd)
        poll = select.poll()
        poll.register(self._read_fd, 0)  # its hang-up is told unasked
        limit, is_gone = GrantedLimit(limit_s), False
        while not is_gone and not limit.is_over():
            is_gone = bool(poll.poll(LOOK_MS))
        os.close(self._read_fd)
        self._read_fd = self._held_fd = -1
        return is_gone

    def prepare(self) -> None:
        """Open the pipe for the process that is about to be forked."""
        if self._read_fd < 0 and os.getpid() == self._pid:
            with contextlib.suppress(OSError):  # without a descriptor left nobody is waited for
                self._read_fd, self._held_fd = os.pipe2(os.O_CLOEXEC)


_watched: WeakSet[ForkedCopies] = WeakSet()


def _prepare_fork() -> None:
    for copies in list(_watched):
        copies.prepare()


os.register_at_fork(before=_prepare_fork)


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
