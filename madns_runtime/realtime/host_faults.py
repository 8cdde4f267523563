"""Faults of a run in real time, at its host: what is ordered from agents, what befalls messages, who is lost by it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from time import monotonic

from madns_runtime.faults.intended_losses import RETURN_S_MIN, IntendedLosses
from madns_runtime.faults.message_faults import MessageEnds, MessageFaults
from madns_runtime.protocol.host_peers import INCARNATIONS_MAX
from madns_runtime.protocol.link_settings import SendQueueFull
from madns_runtime.protocol.messages import AgentFault, Service
from madns_runtime.protocol.states import HostState
from madns_runtime.realtime.host_core import RealtimeCore
from madns_runtime.timeline import fault_kinds as words
from madns_runtime.timeline.action import ActionRefused, TimelineAction
from madns_runtime.timing.rate import has_tick_from


class HostFaults:
    """
    Carries out the faults of a run; a handler of `timeline.action.ActionHandler`.

    Args:
        core: Of the host.
    """

    def __init__(self, core: RealtimeCore) -> None:
        config, port, half, guard = core.launch.config, core.port, core.half, core.guard
        self.intended = IntendedLosses()
        self._goes_on = config.on_agent_loss == "continue"
        self._duration_s = config.time.duration_s
        self._tick_hz = config.agents.tick_hz
        self._phases_s = core.launch.phases_s
        self._is_stopped = False
        self._port = port
        self._half = half
        self._pump = core.pump
        self._messages = MessageFaults(
            config.agents.resolved_names(),
            config.seed,
            # As in lockstep: what is held beyond the end of the run is left, also while agents make their summaries.
            now_s=lambda: min(port.now_s(), self._duration_s),
            ends=MessageEnds(
                receive=lambda agent, message: guard(half.take_now, agent, message),
                send=port.send,
                engage=self._engage,
                held=self._arm,
            ),
        )
        self.to_mapping = self._messages.to_mapping
        # Infinite is never: the timer is made once and moved.
        self._timer = core.reactor.call_at(math.inf, self._due)

    def begin(self, action: TimelineAction) -> list[str]:
        """
        Put a fault in force, and return which agents it does not find.

        Raises:
            ActionRefused: The run does not go on without an agent, or none of them is there.
        """
        if action.word in words.MESSAGE_FAULTS:
            self._messages.begin(action)
            return []
        is_loss = action.word in words.LOSSES
        absent = self._kill(action) if is_loss else self._order(action, begins=True)
        if len(absent) == len(action.agents):
            raise ActionRefused(words.nobody_words(action))
        return absent

    def end(self, action: TimelineAction) -> None:
        """Lift a fault; an agent that was killed returns by itself."""
        if action.word in words.MESSAGE_FAULTS:
            self._messages.end(action)
        elif action.word not in words.LOSSES:
            self._order(action, begins=False)

    def end_at(self, end_s: float) -> None:
        """Let the run end at simulated time *end_s*, s: agents that were to return after it are not waited for."""
        self._duration_s = end_s
        self._is_stopped = True
        self._await_returns()

    # Agents ---------------------------------------------------------------------------------------

    def _kill(self, action: TimelineAction) -> list[str]:
        if not self._goes_on:
            raise ActionRefused(words.MUST_CONTINUE)
        after_s = 0.0 if action.word == words.RESTART else action.for_s
        now_s = self._port.now_s()
        returns_s = None if after_s is None else now_s + after_s
        why = words.killed_words(action)
        absent = [] if after_s is None else self._worn_out(action.agents)
        if absent and len(absent) == len(action.agents):
            names = ", ".join(absent)
            raise ActionRefused(
                f"{names}: started {INCARNATIONS_MAX} times, as often as a run takes one"
            )
        for agent in [name for name in action.agents if name not in absent]:
            # As in lockstep, one for which no tick would be left stays away.
            will_return = after_s is not None and self._is_in_time(
                agent, now_s + max(after_s, RETURN_S_MIN)
            )
            value = after_s if after_s is not None and will_return else math.nan
            order = AgentFault(action.number, action.word, True, value, why)
            # Who is being killed is as good as gone: a second order would not be heard, and says when it returns.
            if not self.intended.is_coming(agent) and self._send(agent, order):
                self.intended.order(agent, why, returns_s=returns_s)
                self._port.session.agent_is_being_killed(agent, monotonic())
            else:
                absent.append(agent)
        self._await_returns()
        return absent

    def _worn_out(self, agents: Sequence[str]) -> list[str]:
        """Return those of some agents that the host would not take back once more."""
        peers = self._port.session.peers
        return [
            name for name in agents if len(peers[name].incarnation_ids_seen) >= INCARNATIONS_MAX
        ]

    def _order(self, action: TimelineAction, *, begins: bool) -> list[str]:
        """Have agents begin or end a fault of their steps; return who is not there."""
        factor = words.factor_of(action)
        order = AgentFault(action.number, action.word, begins, factor)
        return [
            agent
            for agent in action.agents
            if (begins and self.intended.is_coming(agent)) or not self._send(agent, order)
        ]

    def _send(self, agent: str, order: AgentFault) -> bool:
        self._port.must_pump = True
        try:
            return self._port.session.send(agent, order, Service.SYNC, monotonic())
        except SendQueueFull:  # it takes nothing
            return False

    def lost(self, agent: str, incarnation: int) -> str | None:
        """Note that an incarnation of an agent is lost, and return why if that was ordered."""
        return self.intended.take(agent, incarnation)

    def returned(self, agent: str) -> None:
        """Note that an agent is back."""
        self.intended.returned(agent)
        self._await_returns()

    def _await_returns(self) -> None:
        are_due = self.intended.are_expected(self._is_in_time)
        # A stop is no loss of those who would be back without it.
        are_any = self.intended.are_expected(lambda agent, returns_s: True)
        are_cut_off = self._is_stopped and not are_due and are_any
        self._port.session.await_returns(are_due, are_cut_off=are_cut_off)

    def _is_in_time(self, agent: str, returns_s: float) -> bool:
        """Tell whether a tick is left for an agent that returns at simulated time *returns_s*, s."""
        phase_s = self._phases_s.get(agent, 0.0)
        return has_tick_from(returns_s, self._duration_s, self._tick_hz, phase_s)

    # Messages -------------------------------------------------------------------------------------

    def _engage(self, is_on: bool) -> None:
        messages = self._messages if is_on else None
        self._half.intake = None if messages is None else messages.take
        self._port.faults = self._half.carrier.faults = messages

    def _arm(self) -> None:
        next_s = self._messages.next_s()
        self._timer.reschedule(self._port.due_s(next_s, end_s=self._duration_s))

    def _due(self) -> None:
        if not self._port.is_in(HostState.SIMULATION_START):
            return  # what waits still is left: the half may have made its summary
        self._messages.release()
        self._arm()
        self._pump()
