"""A timeline while its run goes on, by simulated times alone."""

import math
from typing import Any

import pytest

from madns_runtime.timeline import runner as runner_module
from madns_runtime.timeline.action import ActionKind, TimelineAction
from madns_runtime.timeline.dispatcher import Dispatcher
from madns_runtime.timeline.entries import ScheduledEntry
from madns_runtime.timeline.runner import OrderedAction, TimelineRunner

KINDS = {
    word: ActionKind(word=word, summary="", lasting=lasting)
    for word, lasting in (("kill", "may"), ("annotate", "never"), ("live", "never"))
}


class Noting:
    """A handler that notes what it does, and when it was due."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str, float]] = []

    def begin(self, action: TimelineAction) -> None:
        self.calls.append(("begin", action.word, action.t_s))

    def end(self, action: TimelineAction) -> None:
        self.calls.append(("end", action.word, action.t_s))


def a_runner(*entries: ScheduledEntry) -> tuple[TimelineRunner, Noting, list[dict[str, Any]]]:
    handler, events = Noting(), list[dict[str, Any]]()
    dispatcher = Dispatcher(
        {"kill": handler, "annotate": handler},
        lambda event, **values: events.append({"event": event, **values}),
    )
    return TimelineRunner(entries, KINDS, dispatcher, seed=1, duration_s=100.0), handler, events


def test_what_lasts_ends_and_ends_come_before_begins() -> None:
    runner, handler, events = a_runner(
        ScheduledEntry(action="kill", at_s=10.0, for_s=5.0, agents=("a",)),
        ScheduledEntry(action="annotate", at_s=15.0),
    )

    assert runner.next_s == 10.0
    runner.run_due(9.9)
    assert handler.calls == []
    runner.run_due(10.0)
    assert runner.next_s == 15.0
    assert [action.word for action in runner.in_force] == ["kill"]
    runner.run_due(20.0)

    assert handler.calls == [
        ("begin", "kill", 10.0),
        ("end", "kill", 10.0),
        ("begin", "annotate", 15.0),
    ]
    assert [(each["event"], each["number"], each["delay_s"]) for each in events] == [
        ("action_began", 0, 0.0),
        ("action_ended", 0, 5.0),
        ("action_began", 1, 5.0),
    ]
    assert runner.next_s is None
    assert runner.in_force == ()


def test_what_begins_a_little_late_ends_before_what_begins_at_its_end() -> None:
    runner, handler, _ = a_runner(
        ScheduledEntry(action="kill", at_s=10.0, for_s=5.0, agents=("a",)),
        ScheduledEntry(action="kill", at_s=15.0, for_s=5.0, agents=("a",)),
    )

    runner.run_due(10.0004)
    assert runner.next_s == 15.0
    runner.run_due(15.0003)

    assert handler.calls == [
        ("begin", "kill", 10.0),
        ("end", "kill", 10.0),
        ("begin", "kill", 15.0),
    ]


def test_what_begins_later_than_it_should_end_lasts_as_long_as_it_is_to() -> None:
    runner, _, events = a_runner(
        ScheduledEntry(action="kill", at_s=10.0, for_s=5.0, agents=("a",)),
    )

    runner.run_due(18.0)
    runner.run_due(22.9)
    assert len(events) == 1
    runner.run_due(23.0)

    assert [each["event"] for each in events] == ["action_began", "action_ended"]


def test_an_end_that_is_no_binary_number_comes_at_its_tick() -> None:
    runner, _, events = a_runner(
        ScheduledEntry(action="kill", at_s=0.1, for_s=0.2, agents=("a",)),
    )

    runner.run_due(0.1)
    runner.run_due(0.3)

    assert [each["event"] for each in events] == ["action_began", "action_ended"]


def test_without_for_s_an_action_is_in_force_until_the_end_of_the_run() -> None:
    runner, _, events = a_runner(ScheduledEntry(action="kill", at_s=10.0, agents=("a",)))

    runner.run_due(99.0)

    assert runner.next_s is None
    assert [action.word for action in runner.in_force] == ["kill"]
    assert events[0]["lasts"] is True


def test_a_condition_begins_what_waits_for_it_and_the_delay_is_recorded() -> None:
    runner, handler, events = a_runner(
        ScheduledEntry(action="kill", condition=3, for_s=2.0, agents=("a",)),
        ScheduledEntry(action="annotate", condition=4),
    )

    runner.met(3, met_s=7.0, now_s=7.5)
    runner.met(3, met_s=7.2, now_s=7.6)  # by another agent
    runner.run_due(9.5)

    assert handler.calls == [("begin", "kill", 7.0), ("end", "kill", 7.0)]
    assert [each["delay_s"] for each in events] == [0.5, 0.0]


@pytest.mark.parametrize("met_s", [math.nan, math.inf, 50.0])
def test_what_a_condition_begins_ends_whatever_time_the_record_bears(met_s) -> None:
    runner, handler, events = a_runner(
        ScheduledEntry(action="kill", condition=3, for_s=2.0, agents=("a",)),
    )

    runner.met(3, met_s=met_s, now_s=7.5)
    assert runner.next_s == 9.5
    runner.run_due(9.5)

    assert handler.calls == [("begin", "kill", 7.5), ("end", "kill", 7.5)]
    assert [(each["due_s"], each["delay_s"]) for each in events] == [(7.5, 0.0), (9.5, 0.0)]


def test_live_orders_leave_what_waits_for_a_condition_its_room(monkeypatch) -> None:
    monkeypatch.setattr(runner_module, "ORDERS_MAX", 2)
    runner, handler, _ = a_runner(ScheduledEntry(action="kill", agents=("a",), condition=0))
    live = OrderedAction(word="annotate", parameters={})

    answers = [runner.order(live, t_s) for t_s in (1.0, 2.0, 3.0)]
    runner.met(0, met_s=4.0, now_s=4.0)

    assert answers == ["", "", "at most 2 actions may be ordered in one run"]
    assert handler.calls[-1] == ("begin", "kill", 4.0)


def test_orders_take_place_at_once() -> None:
    runner, handler, _ = a_runner()

    refusal = runner.order(OrderedAction(word="kill", agents=("a",), parameters={}), 12.0)

    assert refusal == ""
    assert handler.calls == [("begin", "kill", 12.0)]


def chances_of(*entries: ScheduledEntry, live_s: float | None = None) -> dict[str, list[int]]:
    """Return what the chance of each action hangs on, by word, with one that is ordered live or without."""
    found: dict[str, list[int]] = {}

    class Chances:
        def begin(self, action: TimelineAction) -> None:
            found.setdefault(action.word, []).append(action.chance)

        def end(self, action: TimelineAction) -> None:
            pass

    dispatcher = Dispatcher(dict.fromkeys(KINDS, Chances()), lambda event, **values: None)
    runner = TimelineRunner(entries, KINDS, dispatcher, seed=1, duration_s=100.0)
    if live_s is not None:
        runner.run_due(live_s)
        assert runner.order(OrderedAction(word="live", parameters={}), live_s) == ""
    runner.run_due(99.0)
    return found


def test_chance_of_an_action_hangs_on_no_other_that_takes_place() -> None:
    stands_for = ScheduledEntry(action="annotate", at_s=1.0)
    often = ScheduledEntry(action="annotate", every_s=0.5)
    killing = ScheduledEntry(action="kill", every_s=40.0, agents=("a",), for_s=1.0)

    alone = chances_of(stands_for, killing)["kill"]

    assert len(set(alone)) == 3
    assert chances_of(stands_for, killing, live_s=5.0)["kill"] == alone
    assert chances_of(often, killing)["kill"] == alone
    told = chances_of(stands_for, killing, live_s=5.0)
    assert len({each for own in told.values() for each in own}) == 5
