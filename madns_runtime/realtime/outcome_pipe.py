"""
The pipe by which a supervisor's children tell how their agents ended, a JSON object per line.

Each is written in one piece, so that those of two children never mix, and names the process: {pid, agent, as_ordered, reason,
may_restart, is_run_over} of an agent as its process ends, {pid, agent, killed, returns_after_s} of one that a fault ends with
its process, and {pid, agent, left} at once of one that ends in a process which others may keep.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Final

import orjson

from madns_runtime.plugin.context import clean_text
from madns_runtime.processes import Registration
from madns_runtime.realtime.agent_report import AgentOutcome

REASON_BYTES_MAX: Final = 2048
READ_BYTES_MAX: Final = 65_536
"""Of one turn: a pipe may hold more, as those of kernels with large pages do."""


class OutcomePipe:
    """
    Both ends of it; made before the forks.

    Reaping empties it, too: the loop's reader, called afterwards in the same turn, finds nothing and does not wait.
    """

    def __init__(self) -> None:
        self.read_fd, self.write_fd = os.pipe()
        os.set_blocking(self.read_fd, False)
        self._begun = b""
        """The line of which the rest is still in the pipe."""

    def read(self) -> list[dict[str, Any]]:
        """Return what was told since the last time; some of it the next time, where it is very much."""
        try:
            told = self._begun + os.read(self.read_fd, READ_BYTES_MAX)
        except BlockingIOError:
            return []
        *lines, self._begun = told.split(b"\n")
        return [orjson.loads(line) for line in lines]

    def write_failure(self, reason: str) -> None:
        """Leave word of what ended the process of all its agents: it is none's in particular."""
        self.write_outcomes({"": AgentOutcome(as_ordered=False, reason=reason, may_restart=True)})

    def write_outcomes(self, outcomes: Mapping[str, AgentOutcome]) -> None:
        """Leave word of how each agent ended, as a child's last."""
        for agent, outcome in outcomes.items():
            self._write(
                agent,
                as_ordered=outcome.as_ordered,
                reason=clean_text(outcome.reason)[: REASON_BYTES_MAX // 4],
                may_restart=outcome.may_restart,
                is_run_over=outcome.is_run_over,
            )

    def write_killed(
        self, entry: Registration, agent: str, reason: str, after_s: float | None
    ) -> None:
        """Leave word, as a child that ends without another."""
        entry.remove()
        self._write(agent, killed=reason, returns_after_s=after_s)

    def write_left(self, agent: str) -> None:
        """Tell that an agent has ended while its process goes on: what it owns is to be made safe now."""
        self._write(agent, left=True)

    def _write(self, agent: str, **told: Any) -> None:
        os.write(self.write_fd, orjson.dumps({"pid": os.getpid(), "agent": agent, **told}) + b"\n")
