"""Every wait of the operator has an end: the deadlines that stand, and how long each state of the host may last."""

from __future__ import annotations

import math
from collections.abc import Callable

from madns_runtime.config import RunConfig

MARGIN_S = 10.0
"""The host has its own deadlines and names who missed them; the operator's come this much later."""
STALL_S = 5.0
"""A turn of the loop that took this long means that the operator was stopped (Ctrl-Z), not its children."""
MANUAL_READY_S = 600.0
"""Time to start an agent by hand."""


class Deadlines:
    """Named moments at which something is done; setting one again replaces it."""

    def __init__(self) -> None:
        self._due: dict[str, tuple[float, Callable[[], None]]] = {}

    def set(self, name: str, at_s: float, action: Callable[[], None]) -> None:
        """Call *action* at *at_s*."""
        self._due[name] = (at_s, action)

    def cancel(self, *names: str) -> None:
        """Forget deadlines; unknown ones do no harm."""
        for name in names:
            self._due.pop(name, None)

    def postpone(self, by_s: float) -> None:
        """Move all: for time in which the operator itself was stopped and could not look."""
        self._due = {name: (at_s + by_s, action) for name, (at_s, action) in self._due.items()}

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until the next one, 0 if it is due, None if there is none."""
        if not self._due:
            return None
        return max(0.0, min(at_s for at_s, _ in self._due.values()) - now_s)

    def fire(self, now_s: float) -> None:
        """Do what is due, each once."""
        due = [name for name, (at_s, _) in self._due.items() if at_s <= now_s]
        for name in due:
            entry = self._due.pop(name, None)
            if entry is not None:
                entry[1]()


def state_limit_s(state: str, config: RunConfig) -> float:
    """Return how long the host may stay in *state* before the operator steps in, s."""
    timeouts = config.timeouts
    if config.time.is_lockstep and state == "SIMULATION_START":
        return math.inf  # it goes as fast as it can, which may be slow; its silence is limited
    limits = {
        "HOST_STARTUP": timeouts.agents_ready_s,
        "SIMULATION_SETUP": timeouts.host_setup_s + timeouts.agent_setup_s,
        "HOST_SIMULATION_READY": timeouts.agent_setup_s,
        "SIMULATION_START": timeouts.start_lead_s + config.time.duration_s + timeouts.complete_s,
        "SIMULATION_COMPLETE": timeouts.complete_s,
    }
    return limits.get(state, timeouts.shutdown_s) + MARGIN_S
