"""How long the host may take, as the operator sees it: each state has an end, and a running host is heard of."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from cosmos_cli.launch.deadlines import MARGIN_S, Deadlines, state_limit_s
from madns_runtime.config import RunConfig

LISTEN_TIMEOUT_S = 15.0
"""From the host's start until it listens: imports on a slow board take a few seconds."""
LISTEN_THERE_TIMEOUT_S = 60.0
"""The same on another machine, which may be a slow one, and where workers elsewhere have to answer first."""
HOST_SILENCE_S = 20.0
"""A running host reports twice a second; one that is silent for this long is taken for hung."""
RUNNING_STATE = "SIMULATION_START"
OPEN_STATES = ("HOST_STARTUP", "SIMULATION_SETUP", "HOST_SIMULATION_READY", RUNNING_STATE)
"""In these an agent may still join."""


class HostLimits:
    """
    The deadlines of one host.

    Args:
        deadlines: The loop's.
        config: The run's.
        give_up: Called with what the host did not do.
        stop: Called with the reason when it is to be told to stop.
    """

    def __init__(
        self,
        deadlines: Deadlines,
        config: RunConfig,
        *,
        give_up: Callable[[str], None],
        stop: Callable[[str], None],
    ) -> None:
        self._deadlines = deadlines
        self._config = config
        self._give_up = give_up
        self._stop = stop
        self.state = "HOST_STARTUP"
        self._is_over = False

    @property
    def is_open(self) -> bool:
        """Whether agents may still join the run."""
        return self.state in OPEN_STATES and not self._is_over

    def started(self, *, is_here: bool) -> None:
        """Expect it to listen."""
        is_alone = self._config.executor.kind in ("process", "thread")
        limit_s = LISTEN_TIMEOUT_S if is_here and is_alone else LISTEN_THERE_TIMEOUT_S
        self._limit_phase(limit_s, "has not listened within {:g} s")

    def entered(self, state: str) -> None:
        """Expect the next state, and signs of life of a running one."""
        self.state = state
        self.expect_next_state()
        self.heard()

    def expect_next_state(self) -> None:
        """Begin anew to wait for the next state."""
        if not self._is_over:
            limit_s = state_limit_s(self.state, self._config)
            self._limit_phase(limit_s, f"has been in {self.state} for {{:g}} s")

    def heard(self) -> None:
        """Note a sign of life."""
        if self.state != RUNNING_STATE or self._is_over:
            self._deadlines.cancel("silence")
            return
        limit_s = self._silence_s()
        action = partial(self._give_up, f"has said nothing for {limit_s:g} s")
        self._deadlines.set("silence", time.monotonic() + limit_s, action)

    def told_to_stop(self) -> None:
        """Expect it to heed."""
        limit_s = self._config.timeouts.shutdown_s + MARGIN_S
        self._limit_phase(limit_s, "has not stopped within {:g} s of being told to")

    def alone(self) -> None:
        """Expect its end: nobody is left whom it could wait for."""
        t = self._config.timeouts
        limit_s = t.silence_s + t.complete_s + t.shutdown_s + MARGIN_S
        reason = f"the host has gone on without agents for {limit_s:g} s"
        self._deadlines.set("alone", time.monotonic() + limit_s, partial(self._stop, reason))

    def not_alone(self) -> None:
        """An agent has been started again."""
        self._deadlines.cancel("alone")

    def over(self) -> None:
        """Expect nothing more of it."""
        self._is_over = True
        self._deadlines.cancel("phase", "silence", "alone")

    def _silence_s(self) -> float:
        if self._config.time.is_lockstep:  # it is silent during a call of its own half
            return max(HOST_SILENCE_S, self._config.timeouts.tick_s + MARGIN_S)
        return HOST_SILENCE_S

    def _limit_phase(self, limit_s: float, late: str) -> None:
        """Give up on the host unless its state changes within *limit_s*; *late* says what it did not do."""
        action = partial(self._give_up, late.format(limit_s))
        self._deadlines.set("phase", time.monotonic() + limit_s, action)
