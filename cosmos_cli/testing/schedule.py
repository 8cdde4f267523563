"""
Order of a suite: tests in lockstep beside each other, those in real time alone. Pure.

A run in real time is judged by when things happened; whatever else uses a processor spoils it.
"""

from __future__ import annotations

from collections.abc import Sequence

from cosmos_cli.testing.case import SuiteCase


class SuiteSchedule:
    """
    Tests that have not begun, and those that run.

    Args:
        cases: All tests; in lockstep those of the most work begin first, in real time they keep their order.
        jobs: How many in lockstep may run at once.
    """

    def __init__(self, cases: Sequence[SuiteCase], jobs: int) -> None:
        lockstep = sorted((c for c in cases if c.is_lockstep), key=lambda c: -c.work)
        self.waiting = [*lockstep, *(c for c in cases if not c.is_lockstep)]
        self.running: list[SuiteCase] = []
        self._jobs = jobs

    def begin(self) -> SuiteCase | None:
        """Take the next test that may begin now; None if none may."""
        if not self.waiting or len(self.running) >= self._jobs:
            return None
        if self.running and not (self.waiting[0].is_lockstep and self.running[0].is_lockstep):
            return None
        case = self.waiting.pop(0)
        self.running.append(case)
        return case

    def end(self, case: SuiteCase) -> None:
        """Take note that a test has ended."""
        self.running.remove(case)

    @property
    def is_done(self) -> bool:
        """Whether nothing waits and nothing runs."""
        return not self.waiting and not self.running
