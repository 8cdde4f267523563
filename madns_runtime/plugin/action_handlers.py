"""Handlers of a timeline's actions that both time modes share: the simulation's own, and what agents carry out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.faults.intended_losses import IntendedLosses
from madns_runtime.plain_values import first_few, from_mapping
from madns_runtime.protocol.messages import ActionOrder
from madns_runtime.timeline.action import (
    ActionHandler,
    ActionKind,
    ActionRefused,
    TimelineAction,
)
from madns_runtime.timeline.dispatcher import Dispatcher
from madns_runtime.timeline.kinds import ANNOTATE, DEVICE_FAULT, STOP, kinds_by_word
from madns_runtime.timeline.runner import TimelineRunner

AGENTS_TOLD_MAX = 20


class Annotations:
    """Handler of annotate: its begin and end are events, and that is all."""

    def begin(self, action: TimelineAction) -> None:
        """Do nothing more."""

    def end(self, action: TimelineAction) -> None:
        """Do nothing more."""


class Stops:
    """
    Handler of stop.

    Args:
        stop: Ends the run's simulated time here.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        self._stop = stop

    def begin(self, action: TimelineAction) -> None:
        """End the run's simulated time."""
        self._stop()

    def end(self, action: TimelineAction) -> None:
        """Do nothing: there is no going on."""


class HostHalfActions:
    """
    Handler of actions that the host's half of the simulation carries out.

    Args:
        kinds: Of the simulation, by word.
        call: Calls a method of the half.
        intended: Where agents are noted that an action loses.
    """

    def __init__(
        self, kinds: Mapping[str, ActionKind], call: Callable[..., Any], intended: IntendedLosses
    ) -> None:
        self._kinds = kinds
        self._call = call
        self._intended = intended

    def begin(self, action: TimelineAction) -> None:
        """Call the half's begin_action."""
        kind = self._kinds[action.word]
        self._call("begin_action", with_instance(action, kind))
        if kind.loses_agents:
            self._intended.note(action.agents)

    def end(self, action: TimelineAction) -> None:
        """Call the half's end_action."""
        self._call("end_action", with_instance(action, self._kinds[action.word]))


class AgentOrders:
    """
    Handler of actions that agents carry out: each is sent an order at begin and end.

    Args:
        post: Sends an agent an order; False if it is not there.
    """

    def __init__(self, post: Callable[[str, ActionOrder], bool]) -> None:
        self._post = post

    def begin(self, action: TimelineAction) -> list[str]:
        """
        Order it, and return who is not there.

        Raises:
            ActionRefused: None of its agents is there.
        """
        return self._order(action, is_end=False)

    def end(self, action: TimelineAction) -> list[str] | None:
        """
        Order its end: what it did to an agent that is away is over as it is.

        Raises:
            ActionRefused: None of its agents is there.
        """
        self._order(action, is_end=True)
        return None

    def resume(self, action: TimelineAction, agent: str) -> None:
        """Order its begin of an agent that has returned."""
        self._post(agent, _ordered(action, is_end=False))

    def _order(self, action: TimelineAction, *, is_end: bool) -> list[str]:
        order = _ordered(action, is_end=is_end)
        # Each agent is sent to, whatever became of the one before.
        absent = [agent for agent in action.agents if not self._post(agent, order)]
        if len(absent) == len(action.agents):
            raise ActionRefused(
                f"not there at present: {first_few(action.agents, AGENTS_TOLD_MAX) or 'no agent'}"
            )
        return absent


class AgentHalfActions(AgentOrders):
    """
    Handler of actions that agents' halves carry out.

    Args:
        kinds: Of the simulation, by word.
        post: Sends an agent an order; False if it is not there.
        intended: Where agents are noted that an action loses: those that are ordered it.
    """

    def __init__(
        self,
        kinds: Mapping[str, ActionKind],
        post: Callable[[str, ActionOrder], bool],
        intended: IntendedLosses,
    ) -> None:
        super().__init__(post)
        self._kinds = kinds
        self._intended = intended

    def begin(self, action: TimelineAction) -> list[str]:
        """
        Order it, and return who is not there.

        Raises:
            ActionRefused: None of its agents is there.
        """
        absent = super().begin(action)
        self._note(action, set(action.agents).difference(absent))
        return absent

    def resume(self, action: TimelineAction, agent: str) -> None:
        """Order its begin of an agent that has returned."""
        super().resume(action, agent)
        self._note(action, {agent})

    def _note(self, action: TimelineAction, agents: set[str]) -> None:
        if self._kinds[action.word].loses_agents:
            self._intended.note(agents)


class DeviceFaults(AgentOrders):
    """
    Handler of device_fault: a device, and the faults around it, outlive its agent's start.

    What an agent is told at a fault's end may be lost with it, on the way too: it is told once more when it returns.

    Args:
        post: Sends an agent an order; False if it is not there.
    """

    def __init__(self, post: Callable[[str, ActionOrder], bool]) -> None:
        super().__init__(post)
        self._ends: dict[str, dict[str, ActionOrder]] = {}
        """By agent and device the newest end, if no fault of that device has begun there since."""

    def begin(self, action: TimelineAction) -> list[str]:
        """
        Order it, and return who is not there.

        Raises:
            ActionRefused: None of its agents is there.
        """
        absent = super().begin(action)
        for agent in set(action.agents).difference(absent):
            self._ends.get(agent, {}).pop(str(action.parameters["device"]), None)
        return absent

    def end(self, action: TimelineAction) -> list[str]:
        """Order its end, and return who is not there: of these it ends when they return."""
        order = _ordered(action, is_end=True)
        for agent in action.agents:
            self._ends.setdefault(agent, {})[str(action.parameters["device"])] = order
        return [agent for agent in action.agents if not self._post(agent, order)]

    def returned(self, agent: str) -> None:
        """Order the ends anew that an agent which has returned may have missed."""
        ends = self._ends.pop(agent, {})
        missed = {device: order for device, order in ends.items() if not self._post(agent, order)}
        if missed:
            self._ends[agent] = missed


def _ordered(action: TimelineAction, *, is_end: bool) -> ActionOrder:
    return ActionOrder(
        number=action.number,
        word=action.word,
        parameters=dict(action.parameters),
        t_s=action.t_s,
        for_s=action.for_s,
        is_end=is_end,
    )


def with_instance(action: TimelineAction, kind: ActionKind) -> TimelineAction:
    """Return an action whose parameters are an instance of its kind's class."""
    made: Any = from_mapping(kind.parameters, action.parameters, action.word)
    return dataclasses.replace(action, parameters=made)


def timeline_runner(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
    config: RunConfig,
    declared: Sequence[ActionKind],
    own: Mapping[str, ActionHandler],
    *,
    record: Callable[..., None],
    call: Callable[..., Any],
    post: Callable[[str, ActionOrder], bool],
    stop: Callable[[], None],
    intended: IntendedLosses,
) -> tuple[TimelineRunner, dict[str, ActionKind]]:
    """
    Return what begins and ends a run's actions, and the kinds that have a handler in its time mode, by word.

    Args:
        config: The run.
        declared: The simulation's actions.
        own: Handlers that this time mode has beside those of both, by word.
        record: Writes an event.
        call: Calls a method of the host's half.
        post: Sends an agent an order; False if it is not there.
        stop: Ends the run's simulated time here.
        intended: Where agents are noted that an action loses.
    """
    kinds = kinds_by_word(declared)
    by_word = {kind.word: kind for kind in declared}
    of_host = HostHalfActions(by_word, call, intended)
    of_agents, device_faults = AgentHalfActions(by_word, post, intended), DeviceFaults(post)
    handlers = {
        ANNOTATE.word: Annotations(),
        STOP.word: Stops(stop),
        DEVICE_FAULT.word: device_faults,
        **own,
        **{kind.word: of_host if kind.carried_out_by == "host" else of_agents for kind in declared},
    }
    runner = TimelineRunner(
        config.timeline,
        kinds,
        Dispatcher(
            handlers,
            record,
            # Devices outlive an agent's start, and so do faults around them: only their ends may be missed.
            {kind.word: of_agents.resume for kind in declared if kind.carried_out_by == "agent"},
            returned=device_faults.returned,
        ),
        seed=config.seed,
        duration_s=config.time.duration_s,
    )
    return runner, {word: kind for word, kind in kinds.items() if word in handlers}
