"""Agents that are lost in a run in real time, and that rejoin: what is noted and told of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from madns_runtime.protocol.events import AgentLost, AgentMoved, Phase
from madns_runtime.realtime.announcements import Announcements
from madns_runtime.realtime.host_core import RealtimeCore
from madns_runtime.realtime.host_faults import HostFaults
from madns_runtime.realtime.host_result import HostReport


class AgentLosses:
    """
    Takes note of losses.

    Args:
        core: Of the host.
        report: The host's account.
        faults: Knows which of them were ordered.
        announced: Tells the operator.
        call: Calls the simulation's half, if it is to hear of losses.
    """

    def __init__(
        self,
        core: RealtimeCore,
        report: HostReport,
        *,
        faults: HostFaults,
        announced: Announcements,
        call: Callable[..., Any],
    ) -> None:
        self._report = report
        self._faults = faults
        self._announced = announced
        self._journal = core.journal
        self._call = call
        self._now_s = core.port.now_s
        self._reasons: dict[str, str] = {}

    def moved(self, event: AgentMoved) -> None:
        """Announce the new phase of an agent; a loss that was ordered is announced as such, as in lockstep."""
        is_intended = event.phase is Phase.LOST and self._faults.intended.is_coming(event.agent)
        self._announced.agent_moved(event, is_intended=is_intended)

    def lost(self, loss: AgentLost, *, may_tell: bool) -> None:
        """Note a loss, and tell the half of it if that can take it."""
        agent, reason = loss.agent, loss.reason
        if (why := self._faults.lost(agent, loss.incarnation)) is not None:
            # As in lockstep, whether its process was its own and was killed, or goes on.
            reason = why
            self._report.intended_lost[agent] = reason
            self._announced.log("warning", f"{agent} is lost on purpose: {reason}")
        else:
            self._report.lost[agent] = reason
            self._announced.log("error", f"{agent} is lost: {reason}")
        self._reasons[agent] = reason
        if may_tell:
            self.tell(agent)

    def tell(self, agent: str) -> None:
        """Tell the half that an agent is lost, if it is."""
        if agent in self._reasons:
            self._call("agent_lost", agent, self._reasons[agent])

    def rejoined(self, agent: str) -> None:
        """Note a return, and tell the half of it."""
        self._faults.returned(agent)
        self._announced.log("info", f"{agent} has rejoined at t = {self._now_s():.2f} s")
        self._journal.event("agent_rejoined", agent=agent)
        self._call("agent_rejoined", agent)
