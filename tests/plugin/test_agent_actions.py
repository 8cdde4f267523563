"""Actions of a timeline as one agent carries them out: begins and ends of the simulation's own."""

from __future__ import annotations

from typing import Any

from madns_runtime.plugin.agent_actions import AgentActions
from madns_runtime.protocol.messages import ActionOrder
from madns_runtime.timeline.action import ActionKind, ActionRefused

BRAKE = ActionKind(word="brake", summary="Brakes.", lasting="may", carried_out_by="agent")


class Journal:
    """Notes events."""

    def __init__(self) -> None:
        self.refused: list[str] = []

    def event(self, event: str, **values: Any) -> None:
        self.refused.append(f"{event}: {values['reason']}")


class Start:
    """One start of an agent."""

    def __init__(self, refusal: str = "") -> None:
        self.called: list[tuple[str, int]] = []
        self.journal = Journal()
        self._refusal = refusal
        self._actions = AgentActions(
            "a",
            [BRAKE],
            call=self._call,
            journal=self.journal,  # type: ignore[arg-type]  # one that notes
            own={},
        )

    def take(self, number: int, *, is_end: bool = False) -> None:
        order = ActionOrder(number, "brake", {}, t_s=1.0, for_s=2.0, is_end=is_end)
        self._actions.take(order)

    def _call(self, method: str, action: Any) -> None:
        self.called.append((method, action.number))
        if self._refusal and method == "begin_action":
            raise ActionRefused(self._refusal)


def test_each_action_ends_once() -> None:
    start = Start()

    for number in (3, 4):
        start.take(number)
    for number in (4, 3):
        start.take(number, is_end=True)

    assert start.called == [
        ("begin_action", 3),
        ("begin_action", 4),
        ("end_action", 4),
        ("end_action", 3),
    ]
    assert start.journal.refused == []


def test_what_this_start_of_the_agent_did_not_begin_it_does_not_end() -> None:
    start = Start()

    start.take(3, is_end=True)

    assert start.called == []
    assert start.journal.refused[-1].startswith("action_refused: to end: it was not begun here")


def test_what_was_refused_is_told_once_and_has_no_end() -> None:
    start = Start("no brakes")

    for is_end in (False, True):
        start.take(3, is_end=is_end)

    assert start.called == [("begin_action", 3)]
    assert start.journal.refused == ["action_refused: no brakes"]


def test_what_is_ordered_again_of_an_agent_that_has_returned_begins_once() -> None:
    start, refusing = Start(), Start("no brakes")

    for each in (start, refusing):
        for is_end in (False, False, True):
            each.take(3, is_end=is_end)

    assert start.called == [("begin_action", 3), ("end_action", 3)]
    assert refusing.called == [("begin_action", 3)]
    assert refusing.journal.refused == ["action_refused: no brakes"]
