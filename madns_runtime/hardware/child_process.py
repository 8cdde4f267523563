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


def wait_for(pid: int, deadline_s: float) -> int | None:
    """
    Wait until a child has ended, and return its exit code; None if it lives.

    Args:
        pid: Of the child; 0 is one that was never there, whose exit code is 0, as is that of one let go of before.
        deadline_s: Until when to wait, monotonic, s.
    """
    if not pid:
        return 0
    try:
        fd = os.pidfd_open(pid)
    except OSError:  # ended and reaped; or there is no descriptor, and its end has to be looked for
        while (code := _exit_code(pid)) is None and monotonic() < deadline_s:
            sleep(LOOK_S)
        return code
    try:
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        poll.poll(max(0.0, deadline_s - monotonic()) * 1e3)
    finally:
        os.close(fd)
    return _exit_code(pid)


def _exit_code(pid: int) -> int | None:
    """Return the exit code of a child that has ended, and let go of it; None if it lives."""
    try:
        ended, status = os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:
        return 0
    return os.waitstatus_to_exitcode(status) if ended else None
