"""
Duration of each step of each machine, on stderr: off unless -v is given, with every question of it under -vv.

One switch for the process, as one process carries out one command line. A line comes when its step ends, so that
the last step of which none came is the one that hangs.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from cosmos_cli.ui.console import Console

HERE = "this computer"
WHOLE = "all of it"
VERBOSITY_MAX = 2

_verbosity = 0


def set_verbosity(level: int) -> None:
    """Tell steps (1), or steps and questions (2), or nothing (0)."""
    global _verbosity  # noqa: PLW0603 - a process carries out one command line
    _verbosity = level


def is_on() -> bool:
    """Whether anything is told."""
    return _verbosity > 0


@contextlib.contextmanager
def timed(machine: str, step: str, *, level: int = 1) -> Iterator[None]:
    """
    Tell how long the body took, also if it failed.

    Args:
        machine: Where it happens.
        step: What is done.
        level: From which verbosity on it is told.
    """
    if _verbosity < level:
        yield
        return
    start_s = time.monotonic()
    ending = " (failed)"
    try:
        yield
        ending = ""
    except GeneratorExit:
        ending = ""
        raise
    finally:
        _tell(time.monotonic() - start_s, machine, step + ending)


class Phases:
    """
    Steps that follow each other: one ends when the next begins.

    Args:
        machine: Where they happen.
        now_s: A monotonic clock.
    """

    def __init__(self, machine: str, now_s: Callable[[], float] = time.monotonic) -> None:
        self._machine = machine
        self._now_s = now_s
        self._step = ""
        self._start_s = now_s()

    def begin(self, step: str) -> None:
        """End the step before, if *step* is another; an empty one only ends it."""
        if step == self._step:
            return
        now_s = self._now_s()
        if self._step and is_on():
            _tell(now_s - self._start_s, self._machine, self._step)
        self._step, self._start_s = step, now_s


def _tell(duration_s: float, machine: str, step: str) -> None:
    Console().say(f"{duration_s:9.3f} s  {machine}: {step}")
