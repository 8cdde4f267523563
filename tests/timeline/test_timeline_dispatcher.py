"""Actions reach the handler of their word, and every begin, end and refusal is an event."""

from typing import Any

from madns_runtime.timeline.action import ActionRefused, TimelineAction
from madns_runtime.timeline.dispatcher import Dispatcher


class Heard:
    """A handler that notes what it is told, and refuses agents named agent-bad."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []

    def begin(self, action: TimelineAction) -> list[str] | None:
        if "agent-bad" in action.agents:
            raise ActionRefused("agent-bad is no agent of this run")
        self.calls.append(("begin", action.number))
        return None

    def end(self, action: TimelineAction) -> None:
        self.calls.append(("end", action.number))


def an_action(number: int = 0, word: str = "kill", *agents: str) -> TimelineAction:
    return TimelineAction(
        number=number, word=word, agents=agents or ("agent-01",), parameters={}, t_s=1.0, for_s=2.0
    )


def a_dispatcher() -> tuple[Dispatcher, Heard, list[tuple[str, dict[str, Any]]]]:
    events: list[tuple[str, dict[str, Any]]] = []
    handler = Heard()

    def record(event: str, **values: Any) -> None:
        events.append((event, values))

    return Dispatcher({"kill": handler}, record), handler, events


def test_agents_that_are_not_there_are_named_where_others_are() -> None:
    class Finding(Heard):
        def begin(self, action: TimelineAction) -> list[str]:
            return [agent for agent in action.agents if agent == "agent-02"]

    events: list[dict[str, Any]] = []
    dispatcher = Dispatcher({"kill": Finding()}, lambda event, **values: events.append(values))

    dispatcher.begin(an_action(0, "kill", "agent-01", "agent-02"), 1.0, lasts=False)
    dispatcher.begin(an_action(1, "kill", "agent-01"), 1.0, lasts=False)

    assert [each.get("not_there") for each in events] == [["agent-02"], None]


def test_what_is_in_force_goes_on_at_an_agent_that_has_returned() -> None:
    resumed: list[tuple[int, str]] = []
    events: list[str] = []
    dispatcher = Dispatcher(
        {"brake": Heard(), "kill": Heard()},
        lambda event, **values: events.append(event),
        {"brake": lambda action, agent: resumed.append((action.number, agent))},
    )
    for number, word in enumerate(("brake", "kill", "brake", "brake")):
        who = ("agent-01", "agent-02") if number < 3 else ("agent-01",)
        dispatcher.begin(an_action(number, word, *who), 1.0, lasts=number != 2)

    dispatcher.resume("agent-02")
    dispatcher.end(an_action(0, "brake", "agent-01", "agent-02"), 3.0, 3.0)
    dispatcher.resume("agent-02")

    assert resumed == [(0, "agent-02")]
    assert events.count("action_resumed") == 1


def test_an_action_that_lasts_is_in_force_until_its_end() -> None:
    dispatcher, handler, events = a_dispatcher()
    action = an_action()

    assert dispatcher.begin(action, 1.25, lasts=True) == ""
    assert dispatcher.in_force == (action,)
    assert dispatcher.end(action, 3.0, 3.5) == ""

    assert dispatcher.in_force == ()
    assert handler.calls == [("begin", 0), ("end", 0)]
    assert [(event, values["delay_s"]) for event, values in events] == [
        ("action_began", 0.25),
        ("action_ended", 0.5),
    ]


def test_an_end_names_who_is_not_there_to_hear_of_it() -> None:
    class Ending(Heard):
        def end(self, action: TimelineAction) -> list[str]:
            return ["agent-02"]

    events: list[dict[str, Any]] = []
    dispatcher = Dispatcher({"kill": Ending()}, lambda event, **values: events.append(values))
    action = an_action(0, "kill", "agent-01", "agent-02")
    dispatcher.begin(action, 1.0, lasts=True)

    assert dispatcher.end(action, 3.0, 3.0) == ""

    assert [each.get("not_there") for each in events] == [None, ["agent-02"]]


def test_an_end_comes_once() -> None:
    dispatcher, handler, events = a_dispatcher()
    action = an_action()
    dispatcher.begin(action, 1.0, lasts=True)
    dispatcher.end(action, 3.0, 3.0)

    assert "not in force" in dispatcher.end(action, 3.0, 3.0)
    assert len(handler.calls) == len(events) == 2


def test_a_refusal_is_an_event_and_nothing_is_in_force() -> None:
    dispatcher, handler, events = a_dispatcher()

    refusal = dispatcher.begin(an_action(0, "kill", "agent-bad"), 1.0, lasts=True)
    unknown = dispatcher.begin(an_action(1, "kli"), 1.0, lasts=False)

    assert refusal == "agent-bad is no agent of this run"
    assert "'kli'" in unknown
    assert dispatcher.in_force == ()
    assert handler.calls == []
    assert [event for event, _ in events] == ["action_refused", "action_refused"]
