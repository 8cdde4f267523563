"""Limits of the host's states, as the operator sees it: each has an end, and a running host is heard of. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

from cosmos_cli.launch.actions import Agenda
from madns_runtime.config import RunConfig

MARGIN_S = 10.0
"""The host has its own deadlines and names who missed them; the operator's come this much later."""
HOST_SILENCE_S = 20.0
"""A running host reports twice a second; one that is silent for this long, or longer than agents would bear, hangs."""
RUNNING_STATE = "SIMULATION_START"
OPEN_STATES = ("HOST_STARTUP", "SIMULATION_SETUP", "HOST_SIMULATION_READY", RUNNING_STATE)
"""In these an agent may still join."""


class HostLimits:
    """
    The deadlines of one host.

    Args:
        agenda: The supervision's.
        config: The run's.
        overdue: Called with what the host has not done in time.
        alone: Called with the reason to end a host that has gone on without agents.
    """

    def __init__(
        self,
        agenda: Agenda,
        config: RunConfig,
        *,
        overdue: Callable[[str], None],
        alone: Callable[[str], None],
    ) -> None:
        self._agenda = agenda
        self._config = config
        self._overdue = overdue
        self._alone = alone
        self.state = "HOST_STARTUP"
        self._is_over = False

    @property
    def is_open(self) -> bool:
        """Whether agents may still join the run."""
        return self.state in OPEN_STATES and not self._is_over

    def started(self) -> None:
        """Expect it to listen."""
        self._limit_phase(
            self._config.timeouts.host_start_s,
            "has not listened within {:g} s (timeouts.host_start_s)",
        )

    def entered(self, state: str) -> None:
        """Expect the next state, and signs of life of a running one."""
        self.state = state
        self.expect_next_state()
        self.heard()

    def expect_next_state(self) -> None:
        """Begin anew to wait for the next state."""
        if not self._is_over:
            self._limit_phase(
                state_limit_s(self.state, self._config), f"has been in {self.state} for {{:g}} s"
            )

    def heard(self) -> None:
        """Note a sign of life."""
        if self.state != RUNNING_STATE or self._is_over:
            self._agenda.cancel("silence")
            return
        limit_s = self._silence_s()
        self._agenda.after(
            "silence", limit_s, partial(self._overdue, f"has said nothing for {limit_s:g} s")
        )

    def told_to_stop(self) -> None:
        """Expect it to heed."""
        self._limit_phase(
            self._config.timeouts.shutdown_s + MARGIN_S,
            "has not stopped within {:g} s of being told to",
        )

    def alone(self) -> None:
        """Expect its end: nobody is left whom it could wait for."""
        t = self._config.timeouts
        limit_s = t.silence_s + t.complete_s + t.shutdown_s + MARGIN_S
        self._agenda.after(
            "alone",
            limit_s,
            partial(self._alone, f"the host has gone on without agents for {limit_s:g} s"),
        )

    def not_alone(self) -> None:
        """Forget `alone`: an agent has been started again."""
        self._agenda.cancel("alone")

    def over(self) -> None:
        """Expect nothing more of it."""
        self._is_over = True
        self._agenda.cancel("phase", "silence", "alone")

    def _silence_s(self) -> float:
        if self._config.time.is_lockstep:  # it is silent during a call of its own half
            return max(HOST_SILENCE_S, self._config.timeouts.tick_s + MARGIN_S)
        return max(HOST_SILENCE_S, self._config.timeouts.silence_s + MARGIN_S)

    def _limit_phase(self, limit_s: float, late: str) -> None:
        """Give up on the host unless its state changes within *limit_s*; *late* says what it did not do."""
        self._agenda.after("phase", limit_s, partial(self._overdue, late.format(limit_s)))


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
