"""Handlers of a timeline's actions that both time modes share."""

from typing import Any

import pytest

from madns_runtime.config import Agents as AgentSettings
from madns_runtime.config import RunConfig
from madns_runtime.faults.intended_losses import IntendedLosses
from madns_runtime.plugin.action_handlers import DeviceFaults, timeline_runner
from madns_runtime.protocol.messages import ActionOrder
from madns_runtime.timeline.action import ActionKind, TimelineAction
from madns_runtime.timeline.runner import OrderedAction


class Agents:
    """Takes orders of agents, of which some are away."""

    def __init__(self, *away: str) -> None:
        self.away = set(away)
        self.heard: list[tuple[str, int, bool]] = []

    def post(self, agent: str, order: ActionOrder) -> bool:
        if agent in self.away:
            return False
        self.heard.append((agent, order.number, order.is_end))
        return True


def a_fault(number: int, *agents: str, device: str = "gps") -> TimelineAction:
    parameters: dict[str, Any] = {"device": device, "fault": "freeze", "value": None}
    return TimelineAction(
        number=number, word="device_fault", agents=agents, parameters=parameters, t_s=1.0, for_s=2.0
    )


def test_a_fault_of_a_device_whose_agent_is_away_at_its_end_ends_when_that_returns() -> None:
    agents = Agents()
    faults = DeviceFaults(agents.post)
    action = a_fault(0, "a", "b")
    faults.begin(action)
    agents.away.add("b")

    assert faults.end(action) == ["b"]
    faults.returned("b")  # and is away again before it was told
    agents.away.clear()
    agents.heard.clear()
    faults.returned("b")
    faults.returned("b")

    assert agents.heard == [("b", 0, True)]


def test_an_end_that_may_have_been_lost_with_its_agent_is_ordered_anew_and_no_end_before_a_begin() -> (
    None
):
    agents = Agents()
    faults = DeviceFaults(agents.post)
    faults.begin(a_fault(0, "a", "b"))
    faults.end(a_fault(0, "a", "b"))
    faults.begin(a_fault(1, "b"))
    faults.begin(a_fault(2, "a", device="imu"))
    agents.heard.clear()

    faults.returned("a")
    faults.returned("b")

    assert agents.heard == [("a", 0, True)]


def test_a_fault_whose_agents_are_all_away_at_its_end_is_no_refusal() -> None:
    agents = Agents()
    faults = DeviceFaults(agents.post)
    faults.begin(a_fault(0, "a"))
    agents.away.add("a")

    assert faults.end(a_fault(0, "a")) == ["a"]


@pytest.mark.parametrize("carried_out_by", ["host", "agent"])
def test_agents_that_a_simulations_action_loses_are_told_whichever_half_carries_it_out(
    carried_out_by: Any,
) -> None:
    agents = Agents("c")
    intended = IntendedLosses()
    kinds = [
        ActionKind(
            word=word, summary="x", carried_out_by=carried_out_by, loses_agents=word == "sink"
        )
        for word in ("sink", "float")
    ]
    config = RunConfig(
        run="0001-t",
        scenario="t",
        simulation="x",
        base_directory=".",
        agents=AgentSettings(count=3),
    )
    runner, _ = timeline_runner(
        config,
        kinds,
        {},
        record=lambda *_, **__: None,
        call=lambda *_: None,
        post=agents.post,
        stop=lambda: None,
        intended=intended,
    )

    runner.order(OrderedAction(word="float", agents=("a",), parameters={}), 1.0)
    before = intended.names()
    runner.order(OrderedAction(word="sink", agents=("b", "c"), parameters={}), 2.0)

    assert before == []
    assert intended.names() == (["b"] if carried_out_by == "agent" else ["b", "c"])
