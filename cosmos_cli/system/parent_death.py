"""A child of this process that does not outlive it: the kernel tells it to end."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal

PR_SET_PDEATHSIG = 1
EXIT_CODE_INTERRUPTED = 130


def end_with_parent() -> None:
    """Ask for SIGTERM at the parent's death; run in a child before its program, from a parent without threads."""
    parent = os.getppid()
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != parent:
        os._exit(EXIT_CODE_INTERRUPTED)
