"""The end of an agent's run: it listens until the host has come to all that was sent in its ticks."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import monotonic

from madns_runtime.config import Timeouts
from madns_runtime.protocol.states import AgentState
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.realtime.agent_link import AgentPort

DRAIN_S = 0.1
"""After the last tick's period, and after the host's answer, an agent listens this much longer ..."""
DRAIN_SHARE = 0.25
"""... and no longer than this share of the time in which agents must be complete."""


class LastAnswers:
    """
    Asks the host for an answer behind what was sent last, and listens until it has come.

    A host that was held up has not read what agents sent before their ends: what it answers to that is not lost. It is
    asked when the last tick's period is over: all agents' last ticks are due before, and a thousand that ask one by one
    would hold them up.

    Args:
        reactor: The loop.
        port: The agent's.
        timeouts: Of the time in which agents must be complete half is for a host that does not answer.
        pump: Sends what is due.
        finish: Called once all has come, while the run goes on.
    """

    def __init__(
        self,
        reactor: Reactor,
        port: AgentPort,
        timeouts: Timeouts,
        *,
        pump: Callable[[], None],
        finish: Callable[[], None],
    ) -> None:
        self._port = port
        self._patience_s = timeouts.complete_s / 2
        self._drain_s = min(DRAIN_S, DRAIN_SHARE * timeouts.complete_s)
        self._pump = pump
        self._finish = finish
        self._end_s = math.inf
        self._asked_s = math.inf
        # Infinite is never: the timer is made once and moved.
        self._timer = reactor.call_at(math.inf, self._look)

    def begin(self, end_s: float) -> None:
        """Take note that the last tick is over; the run ends at *end_s* on this computer's clock."""
        self._end_s = end_s
        self._timer.reschedule(max(end_s, monotonic()))  # not in the midst of a tick

    def cancel(self) -> None:
        """Wait no more."""
        self._timer.cancel()

    def _look(self) -> None:
        # What waits in the socket has come, however late this process is.
        self._port.process.drain()
        session = self._port.session
        if session.state is not AgentState.RUN_SIMULATION:
            return
        now_s = monotonic()
        if self._asked_s == math.inf:
            self._asked_s = now_s
            # One that was due earlier stays so: it tells that this process was held up, for which nobody is blamed.
            session.ping_due_s = min(session.ping_due_s, now_s)
            session.handle_timer(now_s)
        until_s = self._until_s(now_s)
        if now_s >= until_s:
            self._finish()
            return
        self._timer.reschedule(until_s)
        self._pump()

    def _until_s(self, now_s: float) -> float:
        """Return until when to listen, as it looks at *now_s*."""
        until_s = self._end_s + self._drain_s
        if self._port.session.answered_s >= self._asked_s:
            return max(until_s, self._port.session.answer_heard_s + self._drain_s)
        if until_s <= now_s < self._end_s + self._patience_s:
            return now_s + self._drain_s
        return until_s
