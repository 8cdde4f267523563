"""Conditions: bounds, when one is met, what a tap hands to whom, and what the host does with word of it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from madns_runtime.conditions.condition import Condition, ValueBounds, conditions_of
from madns_runtime.conditions.evaluator import ConditionEvaluator
from madns_runtime.conditions.reports import HostConditions
from madns_runtime.conditions.tap import ConditionTap
from madns_runtime.config import Agents, Recording, RunConfig, from_mapping, to_mapping
from madns_runtime.protocol.codec import decode_message, encode_message
from madns_runtime.protocol.messages import ConditionMet
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import Field, StreamSchema

DRIVE = StreamSchema("drive", (Field("tick", "", "int"), Field("speed_m_s", "m/s")))
ROUNDED = StreamSchema("state", (Field("tick", "", "int"), Field("x_m", "m", digits=1)))


def condition(**values):
    told = {"number": 0, "name": "fast", "stream": "drive", "field": "speed_m_s"}
    given = {"bounds": ValueBounds.above(10.0), "agents": ("a",)}
    return Condition(**(told | given | values))


@pytest.mark.parametrize(
    ("bounds", "held", "not_held"),
    [
        (ValueBounds.below(2.0), (1.9, -5, True, np.float64(0)), (2.0, 3)),
        (ValueBounds.above(2.0), (2.1, np.int64(3)), (2.0, 1, False)),
        (ValueBounds.within(-1.0, 1.0), (-1.0, 0, 1.0), (-1.1, 1.1)),
        (ValueBounds.equals(3.0, 0.5), (2.5, 3, 3.5), (2.4, 3.6)),
        (ValueBounds.equals(0.8, 0.1), (0.7, 0.9), (0.6999999, 0.9000001)),
        (ValueBounds.equals(1.1, 0.1), (1.0, 1.2), (0.9999999, 1.2000001)),
        (ValueBounds.equals("lost"), ("lost",), ("found", 3)),
        (ValueBounds.within(-1.0, 1.0).negated(), (-1.1, 2), (0.5, 1.0)),
        (ValueBounds.equals("lost").negated(), ("found",), ("lost", 3)),
        (ValueBounds(), ("lost", "", 3), ()),
        (ValueBounds().negated(), (), ("lost", 3)),
    ],
)
def test_bounds_hold_for_values_within_and_never_for_none_of_their_kind(bounds, held, not_held):
    assert [value for value in held if not bounds.holds(value)] == []
    assert [value for value in not_held if bounds.holds(value)] == []
    assert not any(map(bounds.holds, (None, math.nan, np.nan, math.inf, -np.inf, [1], {})))


def test_a_condition_is_met_once_at_the_record_that_meets_it():
    evaluator = ConditionEvaluator(condition())

    met = [evaluator.take(t, v) for t, v in enumerate((1.0, math.nan, 11.0, 1.0, 12.0))]

    assert met == [None, None, 2.0, None, None]


def test_a_condition_that_has_to_hold_for_a_while_begins_anew_when_it_does_not():
    evaluator = ConditionEvaluator(condition(for_s=2.0))

    assert [evaluator.take(t, v) for t, v in enumerate((11, 11, 5, 11, 11))] == [None] * 5
    assert evaluator.look(4.5) is None
    assert evaluator.look(5.5) == 5.0
    assert evaluator.look(6.0) is None


def test_a_condition_has_held_until_the_record_with_which_it_does_not_any_more():
    evaluator = ConditionEvaluator(condition(for_s=0.5))

    assert [evaluator.take(t, v) for t, v in ((1.0, 11), (1.5, 5), (2.0, 11))] == [None] * 3
    assert evaluator.look(2.0) is None
    assert evaluator.take(3.0, 5) == 2.5
    assert evaluator.take(4.0, 11) is None


@pytest.mark.parametrize("absent", [None, math.nan, -math.inf])
def test_a_value_that_is_not_there_ends_no_while(absent):
    evaluator = ConditionEvaluator(condition(for_s=2.0))

    assert [evaluator.take(t, v) for t, v in ((0.0, 11), (1.0, absent))] == [None, None]
    assert evaluator.take(2.5, absent) == 2.0
    counting = ConditionEvaluator(condition(times=2))
    assert [counting.take(t, v) for t, v in ((0.0, 11), (1.0, absent), (2.0, 11))] == [
        None,
        None,
        2.0,
    ]


def test_a_while_that_is_no_binary_number_is_over_at_its_tick():
    evaluator = ConditionEvaluator(condition(for_s=0.2))

    assert [evaluator.take(tick / 10, 11.0) for tick in (1, 2, 3)] == [None, None, 0.3]


def test_records_outside_its_times_do_not_count():
    evaluator = ConditionEvaluator(condition(from_s=2.0, to_s=3.0))

    assert [evaluator.take(t, 11.0) for t in (None, 1.0, 2.0)] == [None, None, 2.0]


def test_a_condition_on_a_number_of_records_is_met_by_the_last_of_them():
    evaluator = ConditionEvaluator(condition(times=3))

    assert [evaluator.take(t, 11.0) for t in range(3)] == [None, None, 2.0]


def tapped(conditions, source="a", now_s=99.0, **more):
    told = []
    report = lambda *met: told.append(met)  # noqa: E731
    tap = ConditionTap(source, conditions, tick_hz=10.0, now_s=lambda: now_s, report=report, **more)
    return tap, told


def test_a_tap_takes_a_records_own_time_from_t_s_or_its_tick_or_the_clock():
    conditions = [
        condition(number=1),
        condition(number=2, stream="gyro", field="rate"),
        condition(number=3, stream="bare", field="speed_m_s"),
    ]
    tap, told = tapped(conditions)

    tap.open("drive", ("tick", "speed_m_s"))((25, 11.0))
    tap.open("gyro", ("tick", "t_s", "rate"))({"tick": 1, "t_s": 7.5, "rate": 11.0})
    tap.open("bare", ("speed_m_s",))((11.0,))

    assert told == [(1, "a", 2.5), (2, "a", 7.5), (3, "a", 99.0)]
    assert tap.open("other", ("tick", "speed_m_s")) is None


@pytest.mark.parametrize("now_s", [-0.5, -0.1, 0.0, None])
def test_what_is_recorded_before_simulated_time_counts_as_of_its_begin(now_s):
    lasting, timed = condition(for_s=5.0), condition(number=1, from_s=0.0)
    tap, told = tapped((lasting, timed), now_s=now_s)

    tap.open("drive", ("speed_m_s",))((11.0,))
    tap.look(4.9)
    assert told == [(1, "a", 0.0)]
    tap.look(5.0)

    assert told == [(1, "a", 0.0), (0, "a", 5.0)]


def test_what_a_record_dates_before_simulated_time_counts_as_of_its_begin():
    lasting, first = condition(for_s=0.4), condition(number=1)
    tap, told = tapped((lasting, first))
    take = tap.open("drive", ("t_s", "speed_m_s"))

    take((-0.5, 11.0))
    take((0.1, 11.0))
    tap.look(0.3)
    assert told == [(1, "a", 0.0)]
    tap.look(0.4)

    assert told == [(1, "a", 0.0), (0, "a", 0.4)]


@pytest.mark.parametrize("t_s", [math.nan, math.inf, -math.inf])
def test_a_record_whose_time_is_none_is_of_the_present_and_where_times_count_of_none(t_s):
    timed = condition(number=1, from_s=50.0)
    lasting = condition(number=2, for_s=5.0)
    tap, told = tapped(
        (condition(stream="s"), *(replace(each, stream="s") for each in (timed, lasting)))
    )
    take = tap.open("s", ("t_s", "speed_m_s"))

    take((t_s, 11.0))
    tap.look(103.9)
    assert told == [(0, "a", 99.0)]
    tap.look(104.0)
    assert told == [(0, "a", 99.0), (2, "a", 104.0)]


@pytest.mark.parametrize("nothing", [None, math.nan])
def test_a_record_that_tells_no_time_behind_one_that_does_is_of_the_present_for_all(nothing):
    early, late = condition(number=1, to_s=50.0), condition(number=2, from_s=50.0)
    lasting = condition(number=3, for_s=5.0)
    tap, told = tapped((early, late, lasting))
    take = tap.open("drive", ("t_s", "speed_m_s"))

    take((98.0, 1.0))
    take((nothing, 11.0))
    tap.look(103.9)
    assert told == [(2, "a", 99.0)]
    tap.look(104.0)

    assert told == [(2, "a", 99.0), (3, "a", 104.0)]


def test_records_count_by_the_time_that_they_are_judged_by(tmp_path):
    calls = StreamSchema("calls", (Field("sent_s", "s"), Field("range_km", "km")))
    given = {"stream": "calls", "field": "range_km"}
    early, late = condition(number=1, to_s=50.0, **given), condition(number=2, from_s=50.0, **given)
    tap, told = tapped((early, late, condition(number=3, **given)))
    recorder = Recorder(RecordFiles(tmp_path, run="0001-test", source="a"), Recording(), tap=tap)
    recorder.open_stream(calls)

    recorder.record("calls", (40.0, 11.0))
    recorder.close()

    assert told == [(1, "a", 40.0), (3, "a", 99.0)]


def test_a_hosts_records_that_name_agents_are_followed_agent_by_agent():
    of_host = condition(agents=("a", "b"), is_of_host=True)
    tap, told = tapped([of_host], "host")
    take = tap.open("drive", ("t_s", "agent", "speed_m_s"))

    for record in ((1.0, "a", 1.0), (2.0, "c", 11.0), (3.0, "b", 11.0), (4.0, "a", 12.0)):
        take(record)

    assert told == [(0, "b", 3.0), (0, "a", 4.0)]
    assert conditions_of("a", [of_host]) == ()


def test_all_records_of_the_host_that_name_agents_are_its_own_too():
    whole = condition(number=0, agents=("host",), is_of_host=True)
    each = condition(number=1, agents=("a", "b"), is_of_host=True)
    thrice = condition(number=2, agents=("host",), is_of_host=True, times=3)
    tap, told = tapped([whole, each, thrice], "host")
    take = tap.open("drive", ("t_s", "agent", "speed_m_s"))

    for record in ((1.0, "a", 1.0), (2.0, "c", 11.0), (3.0, "b", 11.0), (4.0, "a", 12.0)):
        take(record)

    assert told == [(0, "host", 2.0), (1, "b", 3.0), (2, "host", 4.0), (1, "a", 4.0)]


def test_a_recorder_shows_a_tap_what_will_be_read_and_writes_what_it_would_without(tmp_path):
    conditions = [condition(stream="state", field="x_m", bounds=ValueBounds.above(1.0))]
    written = []
    for number, tap in enumerate((None, tapped(conditions)[0])):
        folder = tmp_path / str(number)
        files = RecordFiles(folder, run="0001-test", source="a")
        recorder = Recorder(files, Recording(), tap=tap)
        for schema in (DRIVE, ROUNDED):
            recorder.open_stream(schema)
        recorder.record("state", (0, 1.04))
        recorder.record("state", {"tick": 1, "x_m": 1.06})
        recorder.record("drive", (0, 99.0))
        files.write_waiting()
        written.append([(folder / f"{name}.jsonl").read_bytes() for name in ("state", "drive")])

    assert written[0] == written[1]


def test_a_recorder_shows_a_tap_rounded_values(tmp_path):
    tap, told = tapped([condition(stream="state", field="x_m", bounds=ValueBounds.above(1.0))])
    recorder = Recorder(RecordFiles(tmp_path, run="r", source="a"), Recording(), tap=tap)
    recorder.open_stream(ROUNDED)

    recorder.record("state", (0, 1.04))
    assert told == []
    recorder.record("state", (1, 1.06))
    assert told == [(0, "a", 0.1)]


LOOSE = StreamSchema("loose", (Field("t_s", "s"), Field("speed_m_s", "m/s")), shape="object")


@pytest.mark.parametrize("schema", [DRIVE, LOOSE], ids=lambda schema: schema.name)
def test_a_number_of_records_is_counted_over_all_incarnations(tmp_path, schema):
    counted = condition(stream=schema.name, times=5, from_s=0.1)
    told = []
    for incarnation in (1, 2, 3):
        tap, told = tapped([counted])
        files = RecordFiles(tmp_path, run="r", source="a", incarnation=incarnation)
        recorder = Recorder(files, Recording(), tap=tap)
        recorder.open_stream(schema)
        for number in (0, 1, 2):  # the first is too early, the last is slow
            key = number if schema is DRIVE else number / 10
            recorder.record(schema.name, (key, 5.0 if number == 2 else 11.0))
            recorder.record(schema.name, (key, 12.0))
        assert len(told) == (incarnation >= 2)
        files.write_waiting()

    # The incarnation before met it; should the host not have heard of it, the next record tells.
    assert [met[2] for met in told] == [0.1]


def test_who_returns_to_its_process_counts_on_without_reading_its_records():
    told = []

    def opened(counted):
        counting = [condition(times=5), condition(number=1, stream="rest", times=2)]
        tap, found = tapped(counting, counted=counted)
        names = [field.name for field in DRIVE.fields]
        return tap, found, tap.open("drive", names, lambda: pytest.fail("they are read again"))

    tap, _ = tapped([condition(times=5)])
    take = tap.open("drive", [field.name for field in DRIVE.fields])
    for tick in range(3):
        take((tick, 11.0))
    counted = {**tap.counts(), 1: 1}
    for incarnation, met in ((2, 0), (3, 1)):
        tap, told, take = opened(counted)
        take((10 * incarnation, 11.0))
        take((10 * incarnation + 1, 5.0))
        assert len(told) == met
        counted = tap.counts()

    assert counted == {0: 5, 1: 1}, "of a stream that was not opened, too"


def test_a_condition_that_counts_nothing_begins_anew_with_each_incarnation(tmp_path):
    for incarnation in (1, 2):
        tap, told = tapped([condition()])
        files = RecordFiles(tmp_path, run="r", source="a", incarnation=incarnation)
        recorder = Recorder(files, Recording(), tap=tap)
        recorder.open_stream(DRIVE)
        recorder.record("drive", (1, 11.0))
        files.write_waiting()

        assert told == [(0, "a", 0.1)]


class Journal:
    def __init__(self):
        self.events = []

    def event(self, event, **values):
        self.events.append({"event": event, **values})


def test_the_host_notes_what_is_met_calls_who_waits_and_ends_the_run_that_is_to_end():
    waited = condition(number=1, name="low")
    broken = condition(number=2, name="slip", ends_run=True)
    endings, met, journal = [], [], Journal()
    host = HostConditions(
        [waited, broken], tick_hz=10.0, now_s=lambda: 5.5, end=lambda *end: endings.append(end)
    )
    host.on_met(1, met.append)

    host.hear("a", 1, 5.0)
    host.hear("b", 2, 5.25)
    host.hear("a", 77, 5.0)
    assert (journal.events, met, endings) == ([], [], [])
    host.settle(journal)

    told = {"event": "condition_met", "agent": "a", "met_s": 5.0, "delay_s": 0.5}
    assert journal.events[0] == told | {"condition": "low"}
    assert [(each.agent, each.t_s, each.delay_s) for each in met] == [("a", 5.0, 0.5)]
    assert endings == [("b", "expectation slip is broken at t = 5.25 s", "broken")]
    assert host.unknown_count == 1


@pytest.mark.parametrize(("end_s", "ended"), [(5.5, ["b"]), (5.4, [])])
def test_a_check_that_is_broken_behind_the_end_of_a_run_costs_nobody_its_summary(end_s, ended):
    broken, endings, journal = condition(number=2, name="slip", ends_run=True), [], Journal()
    host = HostConditions(
        [broken], tick_hz=10.0, now_s=lambda: 5.5, end=lambda who, *_: endings.append(who)
    )
    host.end_s = end_s

    host.hear("b", 2, 5.25)
    host.settle(journal)

    assert [event["event"] for event in journal.events] == ["condition_met"]
    assert endings == ended


def test_conditions_travel_to_agents_and_word_of_them_to_the_host():
    config = RunConfig(
        run="r",
        scenario="s",
        simulation="counter",
        base_directory="/",
        agents=Agents(count=1),
        conditions=(condition(bounds=ValueBounds.equals("lost").negated(), to_s=3.0),),
    )

    assert from_mapping(RunConfig, to_mapping(config)).conditions == config.conditions
    assert decode_message(encode_message(ConditionMet(3, 1.5))) == ConditionMet(3, 1.5)
