"""Faults of a lockstep run, at its host: they begin and end between two ticks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from madns_runtime.faults.message_faults import MessageEnds, MessageFaults
from madns_runtime.lockstep.absences import RESTART_DELAY_S, Absences
from madns_runtime.lockstep.host_core import LockstepCore
from madns_runtime.protocol.messages import AgentFault
from madns_runtime.timeline import fault_kinds as kinds
from madns_runtime.timeline.action import ActionRefused, TimelineAction
from madns_runtime.written_times import later_s


class LockstepFaults:
    """
    Carries out the faults of a run; a handler of `timeline.action.ActionHandler`.

    Args:
        core: Of the host.
        absences: Whom the run goes on without.
    """

    def __init__(self, core: LockstepCore, absences: Absences) -> None:
        self._goes_on = core.config.on_agent_loss == "continue"
        self._account = core.account
        self._absences = absences
        self._half = core.half
        self._outbox = core.outbox
        self._clock = core.clock
        self._messages = MessageFaults(
            core.account.names,
            core.config.seed,
            now_s=core.clock.now_s,
            ends=MessageEnds(
                receive=core.half.take_now,
                send=core.outbox.send,
                engage=self._engage,
                held=_nothing,
            ),
        )
        self.to_mapping = self._messages.to_mapping
        self._is_engaged = False

    def begin(self, action: TimelineAction) -> list[str]:
        """
        Put a fault in force, and return which agents it does not find.

        Raises:
            ActionRefused: The run does not go on without an agent, or none of them is there.
            RunEnds: A worker hangs, or nobody is left.
        """
        if action.word in kinds.MESSAGE_FAULTS:
            self._messages.begin(action)
            return []
        there = [name for name in action.agents if not self._is_lost(name)]
        if action.word in kinds.LOSSES and not self._goes_on:
            raise ActionRefused(kinds.MUST_CONTINUE)
        if not there:
            raise ActionRefused(kinds.nobody_words(action))
        if action.word in kinds.LOSSES:
            self._kill(action, there)
        else:
            self._order(action, there, begins=True)
        return [name for name in action.agents if name not in there]

    def end(self, action: TimelineAction) -> None:
        """
        Lift a fault; an agent that was killed returns by itself.

        Raises:
            RunEnds: A worker hangs.
        """
        if action.word in kinds.MESSAGE_FAULTS:
            self._messages.end(action)
        elif action.word not in kinds.LOSSES:
            self._order(action, action.agents, begins=False)

    def release(self) -> None:
        """
        Let go on what faults have held back until now.

        Raises:
            RunEnds: The half raised.
        """
        if self._is_engaged:
            self._messages.release()

    def _order(self, action: TimelineAction, agents: Sequence[str], *, begins: bool) -> None:
        factor = kinds.factor_of(action)
        fault = AgentFault(action.number, action.word, begins, factor)
        self._absences.order(fault, agents)

    def _kill(self, action: TimelineAction, agents: list[str]) -> None:
        after_s = RESTART_DELAY_S if action.word == kinds.RESTART else action.for_s
        why = kinds.killed_words(action)
        begun_s = max(action.t_s, self._clock.t_s)
        returns_s = None if after_s is None else later_s(begun_s, after_s)
        for agent in agents:
            self._account.intended.order(agent, why, returns_s=returns_s)
        # As in real time: what is ordered is told, and one for which no tick would be left stays away.
        will_return = returns_s is not None and self._absences.has_tick_from(returns_s)
        ordered_s = 0.0 if action.word == kinds.RESTART else action.for_s
        value = ordered_s if will_return and ordered_s is not None else math.nan
        fault = AgentFault(action.number, kinds.KILL, True, value, why)
        self._absences.order(fault, agents)
        self._absences.take()

    def _is_lost(self, agent: str) -> bool:
        return self._account.agents[self._account.names.index(agent)].is_lost

    def _engage(self, is_on: bool) -> None:
        self._is_engaged = is_on
        messages = self._messages if is_on else None
        self._half.intercept(messages)
        self._outbox.faults = messages


def _nothing() -> None:
    """Do nothing: the host looks before each tick."""
