"""Orders of a timeline's actions as one agent carries them out, in either time mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from madns_runtime.errors import ConfigurationError
from madns_runtime.plugin.action_handlers import with_instance
from madns_runtime.protocol.messages import ActionOrder
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.timeline.action import ActionKind, ActionRefused, TimelineAction

OwnAction = Callable[[ActionOrder], None]
"""Carries out an action of the framework's at this agent, its begin and its end."""


class AgentActions:
    """
    The actions of one agent.

    Args:
        agent: Its name.
        declared: Actions of the simulation.
        call: Calls a method of the agent's half.
        journal: Of the agent: refusals are recorded.
        own: By word: how the framework's are carried out here.
    """

    def __init__(
        self,
        agent: str,
        declared: Sequence[ActionKind],
        *,
        call: Callable[..., Any],
        journal: RunJournal,
        own: Mapping[str, OwnAction],
    ) -> None:
        self._agent = agent
        self._kinds = {kind.word: kind for kind in declared if kind.carried_out_by == "agent"}
        self._call = call
        self._journal = journal
        self._own = own
        self._begun: set[int] = set()
        """Numbers of the simulation's actions that this start of the agent has begun, and that are to end."""
        self._taken: set[int] = set()
        """Numbers of all whose begin came: in real time one that was ordered while this start set itself up is ordered anew
        once it has returned, as all that is in force."""
        self._refused: set[int] = set()
        """Numbers of those that it has refused to begin: told once, their ends ask for nothing."""

    def take(self, order: ActionOrder) -> None:
        """Carry out an order; one that cannot be is recorded as refused."""
        try:
            if (own := self._own.get(order.word)) is not None:
                own(order)
            elif (kind := self._kinds.get(order.word)) is not None:
                self._take(order, kind)
            else:
                raise ActionRefused("there is no such action here")
        except (ActionRefused, ConfigurationError) as refusal:
            self._journal.event(
                "action_refused", number=order.number, action=order.word, reason=str(refusal)
            )

    def _take(self, order: ActionOrder, kind: ActionKind) -> None:
        action = with_instance(self._action(order), kind)
        if not order.is_end:
            if order.number not in self._taken:
                self._taken.add(order.number)
                self._begin(order, action)
            return
        if order.number in self._refused:
            self._refused.remove(order.number)
            return
        if order.number not in self._begun:
            raise ActionRefused(
                "to end: it was not begun here, or before this agent's present start"
            )
        self._begun.remove(order.number)
        self._call("end_action", action)

    def _begin(self, order: ActionOrder, action: TimelineAction) -> None:
        try:
            self._call("begin_action", action)
        except ActionRefused:
            if order.for_s is not None:
                self._refused.add(order.number)
            raise
        if order.for_s is not None:
            self._begun.add(order.number)

    def _action(self, order: ActionOrder) -> TimelineAction:
        return TimelineAction(
            number=order.number,
            word=order.word,
            agents=(self._agent,),
            parameters=order.parameters,
            t_s=order.t_s,
            for_s=order.for_s,
        )
