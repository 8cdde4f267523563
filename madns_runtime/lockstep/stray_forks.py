"""A process that a plug-in forked in a worker, and that came back from the call as if it were the worker itself."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable

from madns_runtime.lockstep.frames import (
    ABANDONING,
    CLOSING,
    FAILED,
    METHODS,
    POSITIONS,
    encode_frame,
)
from madns_runtime.lockstep.worker_line import HostGone, WorkerLine
from madns_runtime.reactor.forking import CAME_BACK, ForkedCopies, end_child

WAIT_S = 1.0
"""Time that the end of a run waits for processes that a plug-in forked and that may come back yet."""


class StrayForks:
    """
    Tells such a process from the worker; costs nothing but at a fork.

    Args:
        position: What the worker is doing, see `frames`.
    """

    def __init__(self, position: memoryview) -> None:
        self._position = position
        self._at = 0
        """Position at the newest fork; that of the memory is the worker's, which goes on meanwhile."""
        self.forked_at: int | None = None
        """Position at which this process was forked; None in the worker."""
        self._copies: ForkedCopies | None = None

    def watch(self) -> None:
        """Note forks of this process from now on."""
        self._copies = ForkedCopies()
        os.register_at_fork(before=self._note, after_in_child=self._mark)

    def wait(self) -> None:
        """Wait until no forked process may come back any more, at most `WAIT_S`: it has something to tell before the end."""
        if self._copies is not None:
            self._copies.wait_until_gone(WAIT_S)

    def end_stray(self, line: WorkerLine) -> None:
        """End this process if it is not the worker, and tell the host who forked it: both would go on, and record twice."""
        if self.forked_at is None:
            return
        index, doing = divmod(self.forked_at, POSITIONS)
        method = METHODS[doing] or "half, as it was loaded,"
        with contextlib.suppress(HostGone):
            line.say(encode_frame(FAILED, index, f"the agent's {method} {CAME_BACK}"))
        end_child(1)

    def abandon(self, index: int, abandon: Callable[[], None], line: WorkerLine) -> None:
        """Have an agent's half let go of what it has started, and end a process that it forks where it comes back."""
        self._position[0] = index * POSITIONS + ABANDONING
        abandon()
        self.end_stray(line)
        self._position[0] = index * POSITIONS + CLOSING

    def _note(self) -> None:
        self._at = self._position[0]

    def _mark(self) -> None:
        self.forked_at = self._at
