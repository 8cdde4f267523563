"""
Holds a plug-in's code that is imported or asked to its time, and to leaving the process and its output alone.

A file that loops for ever while it is imported, or calls `os._exit(0)`, would end a run without a word. What can be
stopped from within is stopped here, so that file and line are told; code in C that never returns, and
a process that is killed, are for whoever started the process.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import threading
from collections.abc import Iterator
from time import monotonic
from types import FrameType
from typing import Final, NoReturn

LIMIT_S_DEFAULT: Final = 60.0
LOOKS: Final = 20
"""Number of looks within the given time."""
LOOK_INTERVAL_S_MAX: Final = 0.5
DEAF_S: Final = 5.0
"""Code that swallows what stops it is given this much longer; then the process ends."""
DEAF_EXIT_CODE: Final = 70
SCHEDULE_FILE: Final = "/proc/self/schedstat"

_limit_s = LIMIT_S_DEFAULT
_wall_limit_s = math.inf
_is_held = False


class PluginStopped(BaseException):
    """Code of a plug-in was stopped. No Exception, so that its own `except Exception` does not go on regardless."""


def set_limit(limit_s: float, *, wall_limit_s: float = math.inf) -> None:
    """
    Set what every import and question in this process is given from now on.

    Args:
        limit_s: Time in which it waited for a processor not counted.
        wall_limit_s: All time counted: when somebody else gives up, who would not know why.
    """
    global _limit_s, _wall_limit_s  # noqa: PLW0603 - one run a process; imports come from deep inside plug-ins
    _limit_s, _wall_limit_s = limit_s, wall_limit_s


@contextlib.contextmanager
def hold() -> Iterator[None]:
    """
    Stop what runs within after the time that `set_limit` gives it, and refuse it `os._exit`; it prints to stderr.

    Inside another one it stops nothing: the outer one's time is the whole's. In a thread other than the main one
    nothing is stopped, as the interpreter handles signals in the main one alone.

    Raises:
        PluginStopped: It took longer, or wanted to end the process.
    """
    global _is_held  # noqa: PLW0603 - signals and os._exit are the process's
    with contextlib.redirect_stdout(sys.stderr):
        if _is_held or threading.current_thread() is not threading.main_thread():
            yield
            return
        _is_held = True
        try:
            with _alarm(_limit_s, _wall_limit_s), _exit_refused():
                yield
        finally:
            _is_held = False


def waited_s() -> float:
    """Return how long the main thread was ready to run and had no processor, s; 0 where the kernel does not say."""
    try:
        with open(SCHEDULE_FILE, "rb") as file:
            return int(file.read(256).split()[1]) * 1e-9
    except (OSError, ValueError, IndexError):
        return 0.0


@contextlib.contextmanager
def _alarm(limit_s: float, wall_limit_s: float) -> Iterator[None]:
    began_s, waited_before_s = monotonic(), waited_s()
    told_s = min(limit_s, wall_limit_s)

    def look(_number: int, _frame: FrameType | None) -> None:
        passed_s = monotonic() - began_s
        over_s = passed_s - min(limit_s + waited_s() - waited_before_s, wall_limit_s)
        if over_s > DEAF_S:
            sys.stderr.write(
                f"it was not done within {told_s:g} s and does not heed being stopped\n"
            )
            sys.stderr.flush()
            os_exit(DEAF_EXIT_CODE)
        if over_s >= 0:
            raise PluginStopped(f"it was not done within {told_s:g} s")

    interval_s = min(LOOK_INTERVAL_S_MAX, told_s / LOOKS)
    earlier = signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, interval_s, interval_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if earlier is None else earlier)


os_exit = os._exit
"""The true one."""


@contextlib.contextmanager
def _exit_refused() -> Iterator[None]:
    """Let `os._exit` raise meanwhile; a process that was forked meanwhile may end as it likes."""
    pid, is_over = os.getpid(), False

    def refuse(status: int) -> NoReturn:
        if is_over or os.getpid() != pid:  # a plug-in may have kept this function
            os_exit(status)
        raise PluginStopped(f"it called os._exit({status!r})")

    os._exit = refuse
    try:
        yield
    finally:
        is_over = True
        os._exit = os_exit
