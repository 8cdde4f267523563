"""
How far ahead of its deadline a loop has itself woken.

From a timer that fires to the first line of a tick it takes tens of microseconds: the kernel's way back, the loop's, and
what is noted before. A timer set earlier by as much lets a tick begin at its deadline. Pure.
"""

from __future__ import annotations

LEAD_S_MAX = 100e-6
"""The most that a loop may wake too early and wait for without sleeping, s."""
WAIT_S_MAX = 2 * LEAD_S_MAX
"""The most that it then waits, s: meanwhile the estimate of the host's clock may have moved the deadline."""
RAISE_S = 4.5e-6
LOWER_S = 0.5e-6
"""Steps by which the lead follows: nine to one, so that nine wake-ups of ten come before their deadline."""
OVERSLEPT_S = 1e-3
"""A wake-up that is later still was held up by something else, s."""


class WakeLead:
    """
    Time that most wake-ups of one loop take, learned from each.

    It follows their upper tenth: one that was late by milliseconds says nothing of the others. On a computer that
    always takes longer than LEAD_S_MAX, that is the lead.
    """

    __slots__ = ("lead_s",)

    def __init__(self) -> None:
        self.lead_s = 0.0
        """By how much timers are to be set ahead of deadlines, s."""

    def learn(self, took_s: float) -> None:
        """Take note that it took so long from the time that a timer was set to until a tick could begin, s."""
        lead_s = self.lead_s
        if took_s > OVERSLEPT_S:
            return
        if took_s > lead_s:
            self.lead_s = min(lead_s + RAISE_S, LEAD_S_MAX)
        else:
            self.lead_s = max(lead_s - LOWER_S, 0.0)
