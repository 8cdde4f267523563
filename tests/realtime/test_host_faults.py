"""Faults that the host of a run in real time orders of agents: who is being killed hears of no other."""

from types import SimpleNamespace
from typing import Any

import pytest

from madns_runtime.protocol.messages import AgentFault
from madns_runtime.realtime.host_faults import HostFaults
from madns_runtime.timeline.action import ActionRefused, TimelineAction


class Session:
    """A session whose agents are all there."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, AgentFault]] = []
        self.peers = {name: SimpleNamespace(incarnations_seen=["x"]) for name in ("a", "b")}

    def send(self, agent: str, order: AgentFault, *_: Any) -> bool:
        self.sent.append((agent, order))
        return True

    def await_returns(self, are_expected: bool) -> None:
        del are_expected


def some_faults() -> tuple[HostFaults, Session]:
    session = Session()
    config = SimpleNamespace(
        on_agent_loss="continue",
        time=SimpleNamespace(duration_s=60.0),
        seed=1,
        agents=SimpleNamespace(resolved_names=lambda: ("a", "b")),
    )
    port: Any = SimpleNamespace(session=session, now_s=lambda: 10.0, send=None, must_pump=False)
    core: Any = SimpleNamespace(
        launch=SimpleNamespace(config=config),
        port=port,
        half=None,
        guard=None,
        pump=None,
        reactor=SimpleNamespace(call_at=lambda when_s, call: None),
    )
    return HostFaults(core), session


def an_action(number: int, word: str, *agents: str, for_s: float | None = None) -> TimelineAction:
    return TimelineAction(
        number=number, word=word, agents=agents, parameters={}, t_s=10.0, for_s=for_s
    )


def test_a_second_kill_of_one_that_is_being_killed_does_not_say_when_it_returns() -> None:
    faults, session = some_faults()

    assert faults.begin(an_action(0, "kill", "a")) == []
    with pytest.raises(ActionRefused, match="nothing to kill"):
        faults.begin(an_action(1, "kill", "a", for_s=1.0))
    assert faults.begin(an_action(2, "kill", "a", "b", for_s=1.0)) == ["a"]

    assert [(agent, order.number) for agent, order in session.sent] == [("a", 0), ("b", 2)]
    assert faults.lost("a")
    assert faults.intended.returns_s("a") is None
    assert faults.intended.returns_s("b") == 11.0


def test_one_that_was_killed_and_is_back_can_be_killed_again() -> None:
    faults, session = some_faults()
    faults.begin(an_action(0, "kill", "a", for_s=1.0))
    assert faults.lost("a")
    faults.returned("a")

    assert faults.begin(an_action(1, "kill", "a", for_s=1.0)) == []
    with pytest.raises(ActionRefused, match="nothing to hang"):
        faults.begin(an_action(2, "hang", "a"))

    assert [order.number for _, order in session.sent] == [0, 1]
