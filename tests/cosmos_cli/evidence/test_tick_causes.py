"""Totals of why ticks were missed or late, from what agents told and from their records."""

from __future__ import annotations

import pytest

from cosmos_cli.evidence.tick_causes import (
    ABSENT,
    TOLD_CAUSES,
    WORDS,
    AgentCauses,
    cause_totals,
    told_causes,
)


def test_every_cause_has_its_meaning_and_its_cure():
    assert set(WORDS) == set(TOLD_CAUSES)
    assert all(words.meaning and words.cure for words in WORDS.values())


def test_causes_add_up_to_missed_and_late():
    agents = {
        "a": AgentCauses(causes={"wake_up": 5, "step": 2}, missed=4),
        "b": AgentCauses(causes={"step": 1}, missed=1),
    }
    totals = cause_totals(agents, {"a": 4, "b": 1, "c": 0})

    assert (totals.missed, totals.late) == (5, 3)
    assert totals.causes == {"wake_up": 5, "step": 3}
    assert totals.agents == {"a": {"wake_up": 5, "step": 2}, "b": {"step": 1}}
    assert sum(totals.causes.values()) == totals.missed + totals.late


def test_ticks_that_no_agent_told_of_are_those_of_one_that_was_absent():
    totals = cause_totals({"a": AgentCauses(causes={"step": 1}, missed=1)}, {"a": 3, "b": 10})

    assert totals.causes == {"step": 1, ABSENT: 12}


def test_a_cure_of_what_a_timeline_may_have_done_on_purpose_says_so():
    assert "a timeline's `slow`" in WORDS["step"].cure
    assert "a timeline's `step_clock`" in WORDS["clock"].cure


def test_the_dominant_cause_is_told_with_share_and_cure():
    totals = cause_totals(
        {"a": AgentCauses(causes={"wake_up": 3, "garbage": 1}, missed=4)}, {"a": 4}
    )

    (remark,) = totals.remarks(0.005)
    assert "4 ticks missed, 0 late by more than 5 ms: 75% by wake_up" in remark
    assert "SCHED_FIFO where it is refused" in remark  # the run may have had it
    assert totals.hint.startswith("75% by wake_up: ")


def test_a_run_on_time_has_no_remark():
    totals = cause_totals({"a": AgentCauses(causes={}, missed=0)}, {"a": 0})

    assert totals.remarks(0.005) == ()
    assert totals.hint == ""
    assert totals.causes == {}


@pytest.mark.parametrize(
    ("ticks", "causes"),
    [
        ({"causes": {"step": 2}, "missed": 1}, {"step": 2}),
        ({"causes": {"a later version's": 2}}, {"unexplained": 2}),
        ({"causes": {"step": "many", "garbage": -4, "wake_up": True}}, {}),
    ],
)
def test_what_an_agent_told_is_read_with_care(ticks, causes):
    told = told_causes(ticks)

    assert told is not None
    assert {cause: count for cause, count in told.causes.items() if count} == causes


@pytest.mark.parametrize("ticks", [{}, {"causes": None}, {"causes": [1]}])
def test_an_agent_that_tells_nothing_of_causes(ticks):
    assert told_causes(ticks) is None
