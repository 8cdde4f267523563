"""The timeline of a host in real time: stops and those that return, and what is met before simulated time runs."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from madns_runtime.conditions.condition import Condition, ValueBounds
from madns_runtime.conditions.reports import HostConditions
from madns_runtime.realtime.host_link import HostPort
from madns_runtime.realtime.timeline import HostTimeline
from madns_runtime.timeline.entries import ScheduledEntry
from madns_runtime.timeline.runner import OrderedAction


class Session:
    """A session of which one agent is away."""

    def __init__(self) -> None:
        self.away = {"b"}
        self.heard: list[tuple[str, str, float]] = []
        self.awaited: list[bool] = []
        self.end_host_s = 0.0
        self.peers = {name: SimpleNamespace(incarnation_ids_seen=[1]) for name in ("a", "b")}

    def send(self, agent: str, order: Any, *_: Any) -> bool:
        if agent in self.away:
            return False
        self.heard.append((agent, order.word, getattr(order, "t_s", 0.0)))
        return True

    def await_returns(self, are_due: bool, *, are_cut_off: bool = False) -> None:
        del are_cut_off
        self.awaited.append(are_due)

    def agent_is_being_killed(self, agent: str, now_s: float) -> None:
        del agent, now_s

    def end_at(self, end_host_s: float) -> None:
        self.end_host_s = end_host_s


class Events:
    """Takes events of a host."""

    def __init__(self) -> None:
        self.words: list[str] = []

    def event(self, event: str, **values: object) -> None:
        self.words.append(event)


def some_conditions(*conditions: Condition) -> HostConditions:
    return HostConditions(conditions, tick_hz=10.0, now_s=lambda: 0.0, end=lambda *_: None)


def a_timeline(
    session: Session,
    *entries: ScheduledEntry,
    conditions: HostConditions | None = None,
    events: Events | None = None,
) -> tuple[HostTimeline, Any]:
    config: Any = SimpleNamespace(
        on_agent_loss="continue",
        time=SimpleNamespace(duration_s=60.0),
        seed=1,
        agents=SimpleNamespace(resolved_names=lambda: ("a", "b"), tick_hz=10.0),
        timeline=entries,
    )
    port: Any = SimpleNamespace(
        session=session,
        now_s=lambda: 2.0,
        monotonic_s=lambda: 102.0,
        t0_s=100.0,
        send=None,
        must_pump=False,
        is_in=lambda state: True,
    )
    port.due_s = partial(HostPort.due_s, port)
    core: Any = SimpleNamespace(
        launch=SimpleNamespace(config=config, phases_s={}),
        port=port,
        half=SimpleNamespace(call=None),
        guard=lambda call, *given: call(*given),
        pump=lambda: None,
        journal=events or Events(),
        reactor=SimpleNamespace(
            call_at=lambda when_s, call: SimpleNamespace(reschedule=lambda when_s: None)
        ),
    )
    report: Any = SimpleNamespace(duration_s=60.0)
    core.report = report
    program: Any = SimpleNamespace(actions=())
    return HostTimeline(core, program, report, conditions or some_conditions()), core


def test_an_agent_that_returns_before_a_stop_takes_effect_hears_of_it() -> None:
    session, conditions = Session(), some_conditions()
    stop = ScheduledEntry(action="stop", at_s=2.0)
    timeline, core = a_timeline(session, stop, conditions=conditions)
    timeline.resume("a")
    assert (session.heard, conditions.end_s) == ([], 60.0)

    timeline._due()
    session.away.clear()
    timeline.resume("b")

    assert core.report.duration_s == conditions.end_s == 2.3
    assert session.heard == [("a", "stop", 2.3), ("b", "stop", 2.3)]
    assert session.end_host_s == 102.3


def test_after_a_stop_nobody_waits_for_who_would_have_returned_behind_it() -> None:
    session = Session()
    session.away.clear()
    timeline, _ = a_timeline(
        session,
        ScheduledEntry(action="kill", at_s=1.0, for_s=30.0, agents=("a",)),
        ScheduledEntry(action="stop", at_s=2.0),
    )

    timeline._due()

    assert session.awaited == [True, False]


def test_who_is_being_killed_is_not_there_for_what_is_ordered_behind_it() -> None:
    session, events = Session(), Events()
    session.away.clear()
    fault = {"device": "gps", "fault": "freeze", "value": None}
    timeline, _ = a_timeline(
        session,
        ScheduledEntry(action="kill", at_s=1.0, for_s=30.0, agents=("a",)),
        ScheduledEntry(action="device_fault", at_s=1.0, agents=("a", "b"), parameters=fault),
        ScheduledEntry(action="device_fault", at_s=1.0, agents=("a",), parameters=fault),
        events=events,
    )

    timeline._due()

    assert [(agent, word) for agent, word, _ in session.heard] == [
        ("a", "kill"),
        ("b", "device_fault"),
    ]
    assert events.words == ["action_began", "action_began", "action_refused"]


@pytest.mark.parametrize("t0_s", [None, 102.5])
def test_what_waits_for_a_condition_that_is_met_in_set_up_takes_place_at_time_zero(
    t0_s: float | None,
) -> None:
    condition = Condition(
        number=0, name="soon", stream="x", field="y", bounds=ValueBounds.above(1.0), agents=("a",)
    )
    conditions, events = some_conditions(condition), Events()
    entry = ScheduledEntry(action="annotate", condition=0, parameters={"text": "soon"})
    timeline, core = a_timeline(Session(), entry, conditions=conditions, events=events)
    core.port.t0_s, core.port.now_s = t0_s, lambda: -0.5
    core.port.is_in = lambda state: t0_s is not None

    conditions.hear("a", 0, 0.0)
    conditions.settle(events)
    assert events.words == ["condition_met"]
    core.port.t0_s, core.port.now_s, core.port.is_in = 102.5, lambda: 0.0, lambda state: True
    timeline._due()
    timeline._due()

    assert events.words == ["condition_met", "action_began"]


def test_what_would_end_behind_the_run_is_ordered_of_no_agent_that_has_made_its_summary() -> None:
    session, events = Session(), Events()
    timeline, core = a_timeline(
        session,
        ScheduledEntry(action="hang", at_s=59.0, for_s=1.0, agents=("a",)),
        ScheduledEntry(action="hang", at_s=59.5, for_s=0.7, agents=("a",)),
        events=events,
    )

    for now_s in (59.8, 60.3):  # others have still to tell that they are complete
        core.port.now_s = lambda now_s=now_s: now_s
        timeline._due()

    assert events.words == ["action_began", "action_began", "action_ended"]
    assert [word for _, word, _ in session.heard] == ["hang"] * 3


@pytest.mark.parametrize(("now_s", "begun"), [(59.9, ["action_began"]), (60.1, [])])
def test_what_waits_for_a_condition_that_the_host_hears_of_behind_the_end_takes_place_no_more(
    now_s: float, begun: list[str]
) -> None:
    condition = Condition(
        number=0, name="last", stream="x", field="y", bounds=ValueBounds.above(1.0), agents=("a",)
    )
    conditions, events, session = some_conditions(condition), Events(), Session()
    entry = ScheduledEntry(action="hang", condition=0, agents=("a",))
    _, core = a_timeline(session, entry, conditions=conditions, events=events)
    core.port.now_s = lambda: now_s

    conditions.hear("a", 0, 59.9)
    conditions.settle(events)

    assert events.words == ["condition_met", *begun]


def test_an_order_behind_the_end_is_refused_while_agents_make_their_summaries() -> None:
    events, order = Events(), OrderedAction(word="annotate", parameters={"text": "late"})
    timeline, core = a_timeline(Session(), events=events)

    core.port.now_s = lambda: 60.1
    assert timeline._order(order) == "the run is ending"
    core.port.now_s = lambda: 59.9
    assert timeline._order(order) == ""

    assert events.words == ["action_began"]


def test_behind_a_stop_that_comes_with_the_runs_own_end_nothing_takes_place() -> None:
    session, events = Session(), Events()
    timeline, core = a_timeline(
        session,
        ScheduledEntry(action="stop", at_s=59.8),
        ScheduledEntry(action="annotate", at_s=59.9, parameters={"text": "late"}),
        events=events,
    )

    for now_s in (59.8, 59.95):
        core.port.now_s = lambda now_s=now_s: now_s
        timeline._due()

    assert (events.words, core.report.duration_s) == (["action_began"], 60.0)
