"""Results of commands and refusals of messages in a rerun: told in the ticks on record, and as they come where there is none."""

import json
from dataclasses import replace

import pytest

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.messages import CommandResult, TransmissionRefusal
from madns_runtime.simulations.constellation.vehicle import recorded_results
from madns_runtime.simulations.constellation.vehicle.recorded_results import RecordedResults


def write(folder, stream, names, rows):
    fields = [{"name": name, "unit": "", "kind": "json"} for name in names]
    lines = [{"schema": 1, "stream": stream, "shape": "array", "fields": fields}, *rows]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / f"{stream}.jsonl").write_text(text)


@pytest.fixture
def recorded(tmp_path):
    """Three commands of ticks 2, 4 and 6: executed, refused, and one whose execution the run did not live to see."""
    write(tmp_path, "commands", ("tick", "number"), [[2, 0], [4, 1], [6, 2]])
    results = [
        [5, 1, "refused", 0],
        [5, 0, "accepted", 7],
        [8, 0, "executed", 9],
        [8, 2, "postponed", 8],
    ]
    write(tmp_path, "command_results", ("tick", "number", "status", "revision"), results)
    write(tmp_path, "refusals", ("tick", "number", "to", "sent_s"), [[7, 3, "agent-02", 0.4]])
    return RecordedResults(tmp_path)


def result(number, status):
    return CommandResult(number=number, status=status, at_s=0.0, revision=1)


def told(recorded, tick):
    return [(one.number, one.status) for one in recorded.take_results(tick)]


def test_what_comes_early_is_told_in_its_tick_and_in_the_order_on_record(recorded):
    for tick, count in ((2, 1), (4, 2)):
        recorded.commanded(tick, count)
    recorded.hold_result(result(0, "accepted"))
    recorded.hold_result(result(1, "refused"))
    recorded.hold_result(result(0, "executed"))

    assert told(recorded, 4) == []
    assert told(recorded, 5) == [(1, "refused"), (0, "accepted")]
    assert [told(recorded, tick) for tick in (6, 7)] == [[], []]
    assert told(recorded, 8) == [(0, "executed")]


def test_a_revision_is_that_on_record_and_of_others_as_it_comes(recorded):
    recorded.commanded(2, 1)
    recorded.hold_result(result(0, "executed"))
    recorded.hold_result(result(3, "accepted"))

    found = {one.number: one.revision for one in recorded.take_results(8)}
    assert found == {0: 9, 3: 1}


@pytest.mark.parametrize(
    ("today", "told_again"),
    [
        ("0.04 s too late; y: 0.1 N m at most", "0.0423 s too late; y: 0.1 N m at most"),
        ("y: 0.1 N m at most", "y: 0.1 N m at most"),
        ("0.04 s too late; y: 0.2 N m at most", "0.04 s too late; y: 0.2 N m at most"),
    ],
)
def test_how_late_a_command_came_is_that_on_record(today, told_again, tmp_path):
    write(tmp_path, "commands", ("tick", "number"), [[2, 0]])
    names = ("tick", "number", "status", "revision", "reason")
    rows = [[5, 0, "postponed", 7, "0.0423 s too late; y: 0.1 N m at most"]]
    write(tmp_path, "command_results", names, rows)
    recorded = RecordedResults(tmp_path)
    recorded.commanded(2, 1)

    recorded.hold_result(replace(result(0, "postponed"), reason=today))

    assert [one.reason for one in recorded.take_results(5)] == [told_again]


def test_what_the_tank_held_when_a_command_was_over_is_that_on_record(tmp_path):
    """The host of a rerun reads it a tick ahead, when a burn of the same time may not have been commanded yet."""
    write(tmp_path, "commands", ("tick", "number"), [[2, 0]])
    names = ("tick", "number", "status", "revision", "propellant_kg")
    rows = [[3, 0, "accepted", 1, 4.5], [5, 0, "executed", 2, 4.0]]
    write(tmp_path, "command_results", names, rows)
    recorded = RecordedResults(tmp_path)
    recorded.commanded(2, 1)

    for status in ("accepted", "executed"):
        recorded.hold_result(replace(result(0, status), propellant_kg=4.9))

    assert [one.propellant_kg for one in recorded.take_results(5)] == [4.9, 4.0]


def test_what_is_over_and_not_on_record_is_told_no_tick_ahead(recorded):
    recorded.take_results(10)
    recorded.hold_result(result(3, "executed"))
    recorded.hold_result(result(3, "accepted"))

    assert told(recorded, 11) == [(3, "accepted")]
    assert told(recorded, 12) == [(3, "executed")]


def test_what_comes_later_than_on_record_is_told_when_it_comes(recorded):
    recorded.commanded(2, 1)
    recorded.hold_result(result(0, "accepted"))

    assert told(recorded, 9) == [(0, "accepted")]


def test_what_the_recorded_run_was_not_told_any_more_is_not_told(recorded):
    for tick, count in ((2, 1), (4, 2), (6, 3)):
        recorded.commanded(tick, count)
    recorded.hold_result(result(2, "accepted"))
    recorded.hold_result(result(2, "executed"))

    assert told(recorded, 8) == [(2, "accepted")]
    assert told(recorded, 10_000) == []


def test_another_fate_than_on_record_is_told_as_it_comes(recorded):
    for tick, count in ((2, 1), (4, 2)):
        recorded.commanded(tick, count)
    recorded.hold_result(result(1, "executed"))

    assert told(recorded, 5) == [(1, "executed")]


def test_from_the_first_other_command_on_results_are_told_as_they_come(recorded):
    for tick, count in ((2, 1), (3, 2), (6, 3)):
        recorded.commanded(tick, count)
    for number in (0, 1, 2):
        recorded.hold_result(result(number, "executed"))

    assert told(recorded, 7) == [(1, "executed"), (2, "executed")]
    assert told(recorded, 8) == [(0, "executed")]


def test_refusals_are_told_in_their_ticks_and_others_as_they_come(recorded):
    recorded.hold_refusal(TransmissionRefusal(3, "agent-02", 0.4, "no_path"))
    recorded.hold_refusal(TransmissionRefusal(4, "agent-02", 0.5, "no_path"))

    assert [one.number for one in recorded.refusals.take(6)] == [4]
    assert [one.number for one in recorded.refusals.take(7)] == [3]


def test_what_is_held_is_bounded_and_counted(recorded, monkeypatch):
    monkeypatch.setattr(recorded_results, "HELD_MAX", 1)
    recorded.commanded(2, 1)
    recorded.hold_result(result(0, "executed"))
    recorded.hold_result(result(0, "executed"))

    assert told(recorded, 3) == [(0, "executed")]
    assert recorded.overflown == 1


def test_an_agent_without_recorded_results_is_named(tmp_path):
    with pytest.raises(BlamedError, match=r"commands\.jsonl: expected what the recorded run told"):
        RecordedResults(tmp_path / "agent-01")
