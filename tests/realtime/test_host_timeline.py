"""The timeline of a host in real time: a stop reaches those, too, that return before the run is over."""

from types import SimpleNamespace
from typing import Any

from madns_runtime.realtime.timeline import HostTimeline
from madns_runtime.timeline.entries import ScheduledEntry


class Session:
    """A session of which one agent is away."""

    def __init__(self) -> None:
        self.away = {"b"}
        self.heard: list[tuple[str, str, float]] = []
        self.awaited: list[bool] = []
        self.end_host_s = 0.0

    def send(self, agent: str, order: Any, *_: Any) -> bool:
        if agent in self.away:
            return False
        self.heard.append((agent, order.word, getattr(order, "t_s", 0.0)))
        return True

    def await_returns(self, are_expected: bool) -> None:
        self.awaited.append(are_expected)

    def end_at(self, end_host_s: float) -> None:
        self.end_host_s = end_host_s


def a_timeline(session: Session, *entries: ScheduledEntry) -> tuple[HostTimeline, Any]:
    config: Any = SimpleNamespace(
        on_agent_loss="continue",
        time=SimpleNamespace(duration_s=60.0),
        seed=1,
        agents=SimpleNamespace(resolved_names=lambda: ("a", "b"), tick_hz=10.0),
        timeline=entries,
    )
    port = SimpleNamespace(
        session=session,
        now_s=lambda: 2.0,
        monotonic_s=lambda: 102.0,
        t0_s=100.0,
        send=None,
        must_pump=False,
        is_in=lambda state: True,
    )
    core: Any = SimpleNamespace(
        launch=SimpleNamespace(config=config),
        port=port,
        half=SimpleNamespace(call=None),
        guard=lambda call, *given: call(*given),
        pump=lambda: None,
        journal=SimpleNamespace(event=lambda event, **values: None),
        reactor=SimpleNamespace(
            call_at=lambda when_s, call: SimpleNamespace(reschedule=lambda when_s: None)
        ),
    )
    report: Any = SimpleNamespace(duration_s=60.0)
    program: Any = SimpleNamespace(actions=())
    return HostTimeline(core, program, report), report


def test_an_agent_that_returns_before_a_stop_takes_effect_hears_of_it() -> None:
    session = Session()
    timeline, report = a_timeline(session, ScheduledEntry(action="stop", at_s=2.0))
    timeline.resume("a")
    assert session.heard == []

    timeline._due()
    session.away.clear()
    timeline.resume("b")

    assert report.duration_s == 2.3
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
