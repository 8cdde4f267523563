"""Faults that the host of a run in real time orders of agents: who is being killed hears of no other."""

import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from madns_runtime.protocol.host_peers import INCARNATIONS_MAX
from madns_runtime.protocol.link_settings import SendQueueFull
from madns_runtime.protocol.messages import AgentFault, Service
from madns_runtime.protocol.states import HostState
from madns_runtime.realtime.host_faults import HostFaults
from madns_runtime.realtime.host_link import HostPort
from madns_runtime.timeline.action import ActionRefused, TimelineAction


class Session:
    """A session whose agents are all there."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, AgentFault]] = []
        self.full: set[str] = set()
        self.being_killed: list[str] = []
        self.peers = {name: SimpleNamespace(incarnation_ids_seen=["x"]) for name in ("a", "b")}

    def send(self, agent: str, order: AgentFault, *_: Any) -> bool:
        if agent in self.full:
            raise SendQueueFull("65536 messages wait")
        self.sent.append((agent, order))
        return True

    def agent_is_being_killed(self, agent: str, now_s: float) -> None:
        del now_s
        self.being_killed.append(agent)

    def await_returns(self, are_due: bool, *, are_cut_off: bool = False) -> None:
        self.awaited = (are_due, are_cut_off)


PHASES_S = {"a": 0.0, "b": 0.5}
"""Of ticks at 1 Hz."""


def some_faults(now_s: float = 10.0, tick_hz: float = 20.0) -> tuple[HostFaults, Session]:
    session = Session()
    config = SimpleNamespace(
        on_agent_loss="continue",
        time=SimpleNamespace(duration_s=60.0),
        seed=1,
        agents=SimpleNamespace(resolved_names=lambda: ("a", "b"), tick_hz=tick_hz),
    )
    port: Any = SimpleNamespace(session=session, now_s=lambda: now_s, send=None, must_pump=False)
    core: Any = SimpleNamespace(
        launch=SimpleNamespace(config=config, phases_s=PHASES_S if tick_hz == 1.0 else {}),
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


@pytest.mark.parametrize(
    ("for_s", "returning"), [(48.9, "ab"), (49.0, "ab"), (49.1, "b"), (49.5, "b"), (49.6, "")]
)
def test_one_for_whom_no_tick_would_be_left_stays_away_as_in_lockstep(for_s, returning) -> None:
    """At 1 Hz, the last tick of 60 s is at 59 s; b's is due half a second later."""
    faults, session = some_faults(tick_hz=1.0)

    faults.begin(an_action(0, "kill", "a", "b", for_s=for_s))

    assert "".join(agent for agent, order in session.sent if order.value == for_s) == returning
    assert session.awaited == (bool(returning), False)


def test_a_second_kill_of_one_that_is_being_killed_does_not_say_when_it_returns() -> None:
    faults, session = some_faults()

    assert faults.begin(an_action(0, "kill", "a")) == []
    with pytest.raises(ActionRefused, match="nothing to kill"):
        faults.begin(an_action(1, "kill", "a", for_s=1.0))
    assert faults.begin(an_action(2, "kill", "a", "b", for_s=1.0)) == ["a"]

    assert [(agent, order.number) for agent, order in session.sent] == [("a", 0), ("b", 2)]
    assert session.being_killed == ["a", "b"]
    assert faults.lost("a", 1)
    assert faults.intended.returns_s("a") is None
    assert faults.intended.returns_s("b") == 11.0


def test_one_that_was_killed_and_is_back_can_be_killed_again() -> None:
    faults, session = some_faults()
    faults.begin(an_action(0, "kill", "a", for_s=1.0))
    assert faults.lost("a", 1)
    faults.returned("a")

    assert faults.begin(an_action(1, "kill", "a", for_s=1.0)) == []
    with pytest.raises(ActionRefused, match="nothing to hang"):
        faults.begin(an_action(2, "hang", "a"))

    assert [order.number for _, order in session.sent] == [0, 1]


def test_an_agent_that_no_host_would_take_back_again_is_not_sent_away_to_return() -> None:
    faults, session = some_faults()
    session.peers["a"].incarnation_ids_seen = list(range(INCARNATIONS_MAX))

    with pytest.raises(ActionRefused, match="a: started 128 times, as often as a run takes one"):
        faults.begin(an_action(0, "restart", "a"))
    assert faults.begin(an_action(1, "kill", "a", "b", for_s=1.0)) == ["a"]
    assert faults.begin(an_action(2, "kill", "a")) == [], "it is not to return"

    assert [(agent, order.number) for agent, order in session.sent] == [("b", 1), ("a", 2)]


@pytest.mark.parametrize("word", ["kill", "hang"])
def test_an_agent_that_takes_nothing_more_is_not_there(word: str) -> None:
    faults, session = some_faults()
    session.full.add("a")

    assert faults.begin(an_action(0, word, "a", "b")) == ["a"]
    assert not faults.intended.is_coming("a")
    with pytest.raises(ActionRefused, match=f"nothing to {word}"):
        faults.begin(an_action(1, word, "a"))


@pytest.mark.parametrize(
    ("end_s", "behind", "then_s"),
    [(60.0, HostState.BEGIN_SHUTDOWN, 12.0), (11.2, HostState.SIMULATION_START, 11.6)],
)
def test_what_a_fault_holds_beyond_the_end_is_not_handed_in(
    end_s: float, behind: HostState, then_s: float
) -> None:
    now_s, handed_in, armed = [10.0], [], []
    state = [HostState.SIMULATION_START]
    timer = SimpleNamespace(reschedule=armed.append)
    config = SimpleNamespace(
        on_agent_loss="continue",
        time=SimpleNamespace(duration_s=end_s),
        seed=1,
        agents=SimpleNamespace(resolved_names=lambda: ("a", "b"), tick_hz=20.0),
    )
    half = SimpleNamespace(
        take_now=lambda agent, message: handed_in.append(message),
        carrier=SimpleNamespace(faults=None),
        intake=None,
    )
    port: Any = SimpleNamespace(
        session=Session(),
        now_s=lambda: now_s[0],
        send=None,
        t0_s=0.0,
        is_in=lambda wanted: state[0] is wanted,
        faults=None,
    )
    port.due_s = partial(HostPort.due_s, port)
    core: Any = SimpleNamespace(
        launch=SimpleNamespace(config=config, phases_s={}),
        port=port,
        half=half,
        guard=lambda call, *arguments: call(*arguments),
        pump=lambda: None,
        reactor=SimpleNamespace(call_at=lambda when_s, call: timer),
    )
    faults = HostFaults(core)
    action = TimelineAction(
        number=0,
        word="delay_messages",
        agents=("a",),
        parameters={"delay_s": 1.0, "jitter_s": 0.0, "traffic": "with_host"},
        t_s=10.0,
        for_s=None,
    )
    faults.begin(action)
    for message in ("in time", "too late"):
        half.intake("a", message, Service.BEST)
        now_s[0] += 0.5

    now_s[0] = 11.2
    faults._due()
    state[0], now_s[0] = behind, then_s
    faults._due()

    assert handed_in == ["in time"]
    with_host = faults.to_mapping()["with_host"]
    assert (with_host["late"], with_host["released"], with_host["left"]) == (2, 1, 1)
    assert [when_s for when_s in armed if end_s < when_s < math.inf] == []


@pytest.mark.parametrize(("now_s", "returns"), [(58.7, True), (59.0, False), (59.5, False)])
def test_one_that_would_return_behind_the_end_does_not(now_s: float, returns: bool) -> None:
    faults, session = some_faults(now_s)

    assert faults.begin(an_action(0, "kill", "a", for_s=1.0)) == []
    assert faults.begin(an_action(1, "restart", "b")) == []

    kill, restart = (order.value for _, order in session.sent)
    assert kill == 1.0 if returns else math.isnan(kill)
    assert restart == 0.0


def test_one_that_is_started_anew_right_before_the_end_does_not_return() -> None:
    faults, session = some_faults(59.9)

    faults.begin(an_action(0, "restart", "a"))

    assert math.isnan(session.sent[0][1].value)


def test_one_that_is_killed_as_it_returns_is_lost_on_purpose_once_more() -> None:
    faults, _ = some_faults()
    faults.begin(an_action(0, "kill", "a", for_s=1.0))
    faults.lost("a", 1)
    faults.begin(an_action(1, "kill", "a", for_s=1.0))
    faults.returned("a")  # it had said so before it heard of the second

    assert faults.intended.is_coming("a")
    assert faults.lost("a", 2)
    assert faults.intended.returns_s("a") == 11.0
    assert faults.intended.incarnations("a") == [1, 2]


def test_who_was_to_return_after_a_stop_is_not_taken_for_lost_by_it() -> None:
    faults, session = some_faults()
    faults.begin(an_action(0, "kill", "a"))
    assert session.awaited == (False, False)
    faults.begin(an_action(1, "kill", "b", for_s=20.0))
    assert session.awaited == (True, False)

    faults.end_at(12.0)

    assert session.awaited == (False, True)
