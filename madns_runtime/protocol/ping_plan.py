"""When an agent exchanges times with the host."""

from __future__ import annotations

import math
from dataclasses import dataclass

PING_INTERVAL_S = 0.25
PINGS_PER_SILENCE = 2.5
"""Pings come so often at least in the time after which an agent that says nothing is lost."""
PING_SLACK_S_MAX = 0.1
"""The longest that a ping waits for a tick's wake-up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PingPlan:
    """
    When an agent exchanges times with the host.

    Agents of one process share one clock: the first brings it up, and the others only keep it, and tell of themselves,
    so that a thousand agents that start at once do not all ask at once.
    """

    brings_clock_up: bool = True
    """The first exchanges follow closely."""
    delay_s: float = 0.0
    """From the start to the first of one that does not bring the clock up."""
    interval_s: float = PING_INTERVAL_S

    def next_s(self, started_s: float, now_s: float) -> float:
        """
        Return when to ping after a ping at *now_s*: in the agent's own place within the interval.

        Counted from the start, so that agents that all pinged at once, as after set-up, do not go on doing so:
        pings of a whole pack take more than a packet, and their answers a wake-up more.
        """
        first_s = started_s + self.delay_s
        return first_s + self.interval_s * max(
            0, math.ceil((now_s - first_s) / self.interval_s + 0.5)
        )

    def slack_s(self, tick_period_s: float) -> float:
        """Return for how long a ping may wait for a tick's wake-up, s, where ticks come with this period."""
        return min(2 * tick_period_s, PING_SLACK_S_MAX, self.interval_s / 2)
