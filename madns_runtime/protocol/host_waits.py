"""Waits of the host in each of its states, and how long they may be: every wait has a deadline and names whom it is for."""

from __future__ import annotations

from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.states import HostState

AWAITED = {
    HostState.HOST_STARTUP: ("AGENT_READY", Phase.READY),
    HostState.HOST_SIMULATION_READY: ("AGENT_SIMULATION_READY", Phase.SIMULATION_READY),
    HostState.SIMULATION_START: ("SIMULATION_COMPLETE", Phase.COMPLETE),
}
"""Word of every agent that a state waits for, and the phase that it brings them to."""
ENDING = (HostState.BEGIN_SHUTDOWN, HostState.EMERGENCY_SHUTDOWN)
"""States that wait until every agent has stopped."""


class StateWait:
    """
    The wait of the present state.

    Args:
        now_s: When it begins.
        limit_s: How long it may last.
    """

    def __init__(self, now_s: float, limit_s: float) -> None:
        self.begin(now_s, limit_s)

    def begin(self, now_s: float, limit_s: float) -> None:
        """Begin that of another state."""
        self._began_s = now_s
        self.until_s = now_s + limit_s

    def is_over(self, now_s: float) -> bool:
        """Tell whether its deadline has passed."""
        return now_s >= self.until_s

    def lasted_s(self, now_s: float) -> float:
        """Return how long it has lasted, in tenths of a second."""
        return round(now_s - self._began_s, 1)
