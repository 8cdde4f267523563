"""Child processes of the manager: forked with a pair to talk over, and waited for until a deadline."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
from collections.abc import Callable
from time import monotonic, sleep
from typing import Final

from madns_runtime.errors import MachineError
from madns_runtime.hardware import messages

LOOK_S: Final = 0.02
"""Time between looks whether a child has ended, where the kernel does not tell."""


def fork_with_pair(run: Callable[[socket.socket], None]) -> tuple[int, socket.socket]:
    """
    Fork a process that runs *run* with its end of a pair, and return its pid and the other end.

    Raises:
        MachineError: The machine has no room for another process.
    """
    own, other = messages.make_pair()
    sys.stdout.flush()
    sys.stderr.flush()
    try:
        pid = os.fork()
    except OSError as error:
        raise MachineError(f"cannot start a process for a device: {error.strerror}") from error
    if pid == 0:
        run(other)
    other.close()
    return pid, own


def kill(pid: int) -> None:
    """Kill a child that may have ended by itself."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def is_there(pid: int) -> bool:
    """Tell whether a process of this user has that number; it may have ended and wait for its parent."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True


def wait_for(pid: int, deadline_s: float) -> bool:
    """Wait until a child has ended, and return whether it has; 0 is a child that was never there."""
    if not pid:
        return True
    try:
        fd = os.pidfd_open(pid)
    except OSError:  # ended and reaped; or there is no descriptor, and its end has to be looked for
        while not _has_ended(pid) and monotonic() < deadline_s:
            sleep(LOOK_S)
        return _has_ended(pid)
    try:
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        poll.poll(max(0.0, deadline_s - monotonic()) * 1e3)
    finally:
        os.close(fd)
    return _has_ended(pid)


def _has_ended(pid: int) -> bool:
    """Tell whether a child has ended, and let go of it; so has one that was let go of before."""
    with contextlib.suppress(ChildProcessError):
        return os.waitpid(pid, os.WNOHANG)[0] != 0
    return True
