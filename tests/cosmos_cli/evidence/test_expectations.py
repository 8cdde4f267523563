"""Expectations judged over all records: each statistic against numpy, events in order, units, and what is not there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cosmos_cli.evidence.expectations import accumulators, held_times, records
from cosmos_cli.evidence.expectations.judge import judge_expectations
from cosmos_cli.evidence.verdict import CheckResult, conclusion_of_expectations
from cosmos_cli.models.expectation import Expectation, HeldBounds
from madns_runtime.conditions.condition import ValueBounds
from madns_runtime.recording.records import Field

DURATION_S = 100.0
rng = np.random.default_rng(7)
T_S = np.arange(0.0, 100.0, 0.01)
DATA = {name: rng.normal(size=len(T_S)).cumsum() * 0.01 for name in ("a", "b")}


class FakeTable:
    """A table in memory."""

    def __init__(self, name, fields, sources, role="agent"):
        self.name, self.role, self.fields, self._sources = name, role, tuple(fields), sources

    @property
    def rows(self):
        return sum(len(next(iter(columns.values()))) for columns in self._sources.values())

    @property
    def sources(self):
        return tuple(self._sources)

    def has(self, *names):
        return set(names) <= {field.name for field in self.fields}

    def unit(self, source, name):
        return next(field.unit for field in self.fields if field.name == name)

    def batches(self, source, names, rows_max):
        columns = self._sources[source]
        for start in range(0, len(next(iter(columns.values()))), rows_max):
            yield {name: columns[name][start : start + rows_max] for name in names}


def objects(values):
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column


STATE = FakeTable(
    "state",
    (Field("t_s", "s"), Field("x_m", "m")),
    {name: {"t_s": T_S, "x_m": values} for name, values in DATA.items()},
)
EVENTS = FakeTable(
    "events",
    (Field("t_s", "s"), Field("event", "", "str"), Field("details", "", "json")),
    {
        "a": {
            "t_s": objects([None, 1.0, 5.0, 9.0]),
            "event": objects(["start", "burn", "done", "burn"]),
            "details": objects([None, '{"dv_m_s": 2.5}', None, '{"dv_m_s": 0.5}']),
        },
        "b": {
            "t_s": objects([None, 6.0]),
            "event": objects(["start", "done"]),
            "details": objects([None, None]),
        },
    },
)
HOST = FakeTable(
    "host_slots",
    (Field("t_s", "s"), Field("agent", "", "str"), Field("error_deg", "deg")),
    {
        "host": {
            "t_s": np.array([0.0, 0.0, 1.0, 1.0]),
            "agent": objects(["a", "b", "a", "b"]),
            "error_deg": np.array([1.0, -2.0, np.nan, -3.0]),
        }
    },
    role="host",
)
TABLES = {"state": STATE, "events": EVENTS, "host_slots": HOST}


def expect(**values):
    given = {"name": "x", "words": "x", "stream": "state", "field": "x_m", "agents": ("a", "b")}
    return Expectation(**(given | values))


def judge(*expectations, tables=TABLES, is_lockstep=True):
    return judge_expectations(
        expectations, tables, agents=("a", "b"), is_lockstep=is_lockstep, duration_s=DURATION_S
    )


def result_of(**values):
    (result,) = judge(expect(**values)).results
    return result


STATISTICS = {
    "max": np.max,
    "min": np.min,
    "mean": np.mean,
    "rms": lambda x: math.sqrt(np.mean(x**2)),
    "sd": np.std,
    "p99": lambda x: np.quantile(x, 0.99, method="inverted_cdf"),
    "last": lambda x: x[-1],
    "count": len,
    "rate": lambda x: len(x) / 50.0,
}


@pytest.mark.parametrize("rows", [7, 1000, 65_536])
@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_statistic_is_that_of_all_records_in_its_time_however_they_are_read(
    statistic, rows, monkeypatch
):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)

    result = result_of(
        statistic=statistic, bounds=ValueBounds.below(1e9), from_s=20.0, to_s=70.0, agents=("a",)
    )

    until = T_S < 70.0 if statistic == "rate" else T_S <= 70.0
    wanted = STATISTICS[statistic](DATA["a"][(T_S >= 20.0) & until])
    assert result.got == pytest.approx(wanted, rel=1e-12)
    assert result.passed


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("statistic", ["mean", "rms", "sd"])
def test_a_statistic_of_values_that_diverged_is_not_finite_and_breaks_its_check(
    statistic, monkeypatch
):
    monkeypatch.setattr(records, "BATCH_RECORDS", 3)
    values = np.array([1.0, -2.0, 3.0, 1e200, -1e300, 1.7e308, 1.7e308, 1.7e308])
    state = FakeTable("state", STATE.fields, {"a": {"t_s": T_S[:8], "x_m": values}})

    (result,) = judge(
        expect(statistic=statistic, bounds=ValueBounds.below(1.0), agents=("a",)),
        tables={"state": state},
    ).results

    assert (result.got, result.passed) == (None, False)


@pytest.mark.parametrize("rows", [7, 65_536])
def test_first_time_and_settled_are_times_of_records(rows, monkeypatch):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    high = float(np.median(DATA["a"]))
    within = ValueBounds.below(high)
    inside = DATA["a"] < high

    first = result_of(
        statistic="first_time", when=within, bounds=ValueBounds.below(99.0), agents=("a",)
    )
    settled = result_of(
        statistic="settled", when=within, bounds=ValueBounds.below(99.0), agents=("a",)
    )

    assert first.got == T_S[inside][0]
    outside = np.flatnonzero(~inside)
    expected = None if outside[-1] + 1 == len(T_S) else T_S[outside[-1] + 1]
    assert settled.got == expected
    assert (first.unit, settled.unit) == ("s", "s")


@pytest.mark.parametrize("rows", [1, 2, 65_536])
@pytest.mark.parametrize(
    ("t_s", "values", "settled_s"),
    [
        ([80, 100, 90], [1, -1, 1], None),  # what comes last is of before the one outside
        ([80, 100, 90, 110], [1, -1, 1, 1], 110),
        ([80, 110, 90, 95], [-1, 1, -1, 1], 95),
        ([80, 80, 80], [-1, 1, 1], 80),
        ([80, 80, 80], [1, 1, -1], None),
    ],
)
def test_settled_goes_by_the_times_of_records_however_late_they_come(
    t_s, values, settled_s, rows, monkeypatch
):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    columns = {"t_s": np.array(t_s, float), "x_m": np.array(values, float)}
    state = FakeTable("state", STATE.fields, {"a": columns})
    within = ValueBounds(low=0.0)

    (result,) = judge(
        expect(statistic="settled", when=within, bounds=ValueBounds.below(1e3), agents=("a",)),
        tables={"state": state},
    ).results

    assert result.got == settled_s


@pytest.mark.parametrize("seed", range(60))
def test_settled_is_right_though_few_times_are_kept_of_records_that_come_late(seed, monkeypatch):
    chance = np.random.default_rng(seed)
    monkeypatch.setattr(records, "BATCH_RECORDS", int(chance.integers(1, 9)))
    monkeypatch.setattr(accumulators, "TIMES_KEPT", 3)
    count = int(chance.integers(8, 40))
    # A time each, some of which come late by up to the whole run.
    order = np.argsort(np.arange(count) + count * (chance.random(count) < 0.15) * chance.random())
    t_s, inside = order.astype(float), chance.random(count) < 0.85
    state = FakeTable(
        "state", STATE.fields, {"a": {"t_s": t_s, "x_m": np.where(inside, 1.0, -1.0)}}
    )

    (result,) = judge(
        expect(
            statistic="settled",
            when=ValueBounds(low=0.0),
            bounds=ValueBounds.below(1e3),
            agents=("a",),
        ),
        tables={"state": state},
    ).results

    last_s = max(t_s[~inside], default=-1.0)
    assert result.got == min(t_s[t_s > last_s], default=None)


def test_the_worst_agent_is_told_with_its_time_in_the_unit_of_the_check():
    worst = {name: np.abs(values).max() for name, values in DATA.items()}
    agent = max(worst, key=worst.get)
    at_s = T_S[np.abs(DATA[agent]).argmax()]

    result = result_of(bounds=ValueBounds.within(-1.0, 1.0), unit="mm")

    assert (result.agent, result.worst, result.t_s, result.unit) == (agent, agent, at_s, "mm")
    assert abs(result.got) == pytest.approx(worst[agent] * 1000.0)
    assert result.limit == math.copysign(1.0, result.got)
    assert not result.passed
    assert result.agents_broken == 2


@pytest.mark.parametrize("rows", [1, 3, 65_536])
def test_the_first_time_is_the_earliest_in_whatever_order_records_come(monkeypatch, rows):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    columns = {"t_s": np.array([9.0, 4.0, 6.0, 2.0, 5.0]), "x_m": np.array([1.0, 1.0, 1, 0, 1])}
    table = FakeTable("jobs", (Field("t_s", "s"), Field("x_m", "m")), {"a": columns})
    when, bounds = ValueBounds.above(0.5), ValueBounds.below(5.0)
    first = expect(stream="jobs", statistic="first_time", when=when, bounds=bounds, agents=("a",))

    (result,) = judge(first, tables={"jobs": table}).results

    assert (result.got, result.passed) == (4.0, True)


@pytest.mark.parametrize("told", ["of its own", "[1]", "3", '{"other": 1}', "", None])
def test_a_field_called_details_that_holds_no_event_has_no_values_beside(told):
    columns = {"t_s": np.array([1.0, 2.0]), "details": objects([told, '{"x_m": 4}'])}
    fields = (Field("t_s", "s"), Field("details", "", "str"))
    table = FakeTable("told", fields, {"a": columns})
    count = expect(stream="told", statistic="count", bounds=ValueBounds.equals(1), agents=("a",))

    (result,) = judge(count, tables={"told": table}).results

    assert (result.got, result.passed) == (1.0, True)


@pytest.mark.parametrize("words", [["noon", "later"], [[1], {}], [None, "1.5"]])
def test_a_time_that_is_no_number_is_none(words):
    columns = {"t_s": objects(words), "x_m": np.array([1.0, 3.0])}
    fields = (Field("t_s", "", "str"), Field("x_m", "m"))
    table = FakeTable("told", fields, {"a": columns})
    largest = expect(stream="told", statistic="max", bounds=ValueBounds.below(5.0), agents=("a",))

    (result,) = judge(largest, tables={"told": table}).results

    assert (result.got, result.t_s, result.passed) == (3.0, None, True)


NO_TIME = FakeTable(
    "untimed",
    (Field("x_m", "m"), Field("s", "", "str")),
    {"a": {"x_m": np.ones(3), "s": objects(["u"] * 3)}},
)
BOO = {"event": "boo", "must": "not_occur"}
NONE = {"statistic": "count", "bounds": ValueBounds.equals(0)}


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"stream": "state", "field": "y_m", **NONE}, "stream state has no field y_m"),
        ({"stream": "state", "field": "evnt", **BOO}, "stream state has no field evnt"),
        ({"stream": "untimed", "field": "s", "from_s": 2.0, **BOO}, "tell no time"),
        ({"stream": "untimed", "field": "x_m", "to_s": 2.0, **NONE}, "tell no time"),
        ({"stream": "slots", "field": "error_deg", **NONE}, "by the host's half alone"),
    ],
)
def test_what_no_record_could_tell_does_not_hold_for_want_of_records(values, why):
    tables = {**TABLES, "untimed": NO_TIME}

    (result,) = judge(expect(agents=("a",), **values), tables=tables).results

    assert (result.got, result.passed) == (None, False)
    assert why in result.expected


def test_what_events_carry_beside_their_fields_may_be_in_none_of_them():
    result = result_of(stream="events", field="never", agents=("a",), **NONE)

    assert (result.got, result.passed) == (0.0, True)


@pytest.mark.parametrize(("limit_ms", "value_us"), [(1.005, 1005), (4.35, 4350), (2.3, 2300)])
def test_a_value_at_a_limit_in_another_unit_is_at_it(limit_ms, value_us):
    columns = {"t_s": np.array([0.0, 1.0]), "x_us": np.array([0, value_us])}
    table = FakeTable("trips", (Field("t_s", "s"), Field("x_us", "us", "int")), {"a": columns})
    common = {"stream": "trips", "field": "x_us", "unit": "ms", "agents": ("a",)}

    closed, strict = judge(
        expect(bounds=ValueBounds.within(0.0, limit_ms), **common),
        expect(bounds=ValueBounds.below(limit_ms), **common),
        tables={"trips": table},
    ).results

    assert (closed.passed, strict.passed) == (True, False)
    assert (closed.got, strict.got) == (0.0, limit_ms) or closed.got == limit_ms == strict.got


def test_a_limit_is_compared_as_strictly_as_it_says():
    top = float(DATA["a"].max())

    assert not result_of(bounds=ValueBounds.below(top), agents=("a",)).passed
    assert result_of(bounds=ValueBounds(high=top), agents=("a",)).passed


def test_records_count_only_while_a_condition_on_another_stream_holds(monkeypatch):
    monkeypatch.setattr(records, "BATCH_RECORDS", 3)
    mode = FakeTable(
        "mode",
        (Field("t_s", "s"), Field("mode", "", "str")),
        {
            "a": {
                "t_s": np.array([10.0, 20.0, 30.0, 90.0]),
                "mode": objects(["on", "on", "off", "on"]),
            }
        },
    )
    held = HeldBounds(stream="mode", field="mode", bounds=ValueBounds.equals("on"))

    (result,) = judge(
        expect(statistic="count", bounds=ValueBounds.above(0.0), meanwhile=held, agents=("a",)),
        tables={**TABLES, "mode": mode},
    ).results

    wanted = ((T_S >= 10.0) & (T_S < 30.0)) | (T_S >= 90.0)
    assert result.got == np.count_nonzero(wanted)


@pytest.mark.parametrize("rows", [1, 3, 100])
def test_a_condition_holds_by_its_newest_record_where_times_go_back(rows, monkeypatch):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    times_s = [10.0, 20.0, 30.0, 25.0, 40.0, 25.0, 60.0, 50.0, 55.0, 90.0]
    on = [1, 1, 1, 0, 1, 1, 1, 0, 0, 1]
    columns = {"t_s": np.array(times_s), "on": np.array(on, float)}
    mode = FakeTable("mode", (Field("t_s", "s"), Field("on")), {"a": columns})
    held = HeldBounds(stream="mode", field="on", bounds=ValueBounds.equals(1.0))
    many = {"statistic": "count", "bounds": ValueBounds.above(0.0), "agents": ("a",)}

    (result,) = judge(expect(**many, meanwhile=held), tables={**TABLES, "mode": mode}).results

    wanted = ((T_S >= 10.0) & (T_S < 50.0)) | (T_S >= 60.0)
    assert result.got == np.count_nonzero(wanted)

    monkeypatch.setattr(held_times, "CHANGES_MAX", 9)
    (result,) = judge(expect(**many, meanwhile=held), tables={**TABLES, "mode": mode}).results
    assert result.expected == "x (mode.on of a has more than 9 records, and their times go back)"


def test_what_the_host_says_of_one_agent_holds_for_no_other():
    columns = {
        "t_s": np.array([10.0, 20.0]),
        "agent": objects(["a", "a"]),
        "on": np.array([1.0, 0.0]),
    }
    fields = (Field("t_s", "s"), Field("agent", "", "str"), Field("on"))
    tables = {**TABLES, "host_mode": FakeTable("host_mode", fields, {"host": columns}, role="host")}
    held = HeldBounds(stream="mode", field="on", bounds=ValueBounds.equals(1.0))
    count = {"statistic": "count", "bounds": ValueBounds.above(0.0), "meanwhile": held}

    of_a, of_b, of_host = judge(
        expect(agents=("a",), **count),
        expect(agents=("b",), **count),
        expect(agents=("host",), stream="mode", field="on", **count),
        tables=tables,
    ).results

    assert of_a.got == np.count_nonzero((T_S >= 10.0) & (T_S < 20.0))
    assert (of_b.got, of_b.passed) == (0.0, False)
    assert of_host.got == 1.0


def test_a_host_stream_is_judged_agent_by_agent_and_skips_what_is_not_there():
    result = result_of(
        stream="slots",
        field="error_deg",
        is_of_host=True,
        statistic="min",
        bounds=ValueBounds.above(-2.5),
    )

    assert (result.agent, result.got, result.t_s, result.passed) == ("b", -3.0, 1.0, False)
    alone = result_of(
        stream="slots",
        field="error_deg",
        is_of_host=True,
        statistic="count",
        bounds=ValueBounds.below(2.0),
        agents=("a",),
    )
    assert (alone.got, alone.passed) == (1, True)


def event(**values):
    return result_of(**({"stream": "events", "field": "event", "event": "burn"} | values))


def test_an_event_must_occur_in_each_agent_or_in_none():
    assert not event().passed
    assert (event().agent, event().got) == ("b", None)
    there = event(agents=("a",))
    assert (there.passed, there.got, there.t_s, there.limit) == (True, 1.0, 1.0, DURATION_S)
    assert event(agents=("a",), to_s=0.5).passed is False
    never = event(must="not_occur")
    assert (never.passed, never.agent, never.got, never.t_s) == (False, "a", 2, 1.0)
    assert event(must="not_occur", event="lost").passed
    assert event(event="start").got == 0.0, "what comes before time runs counts as its begin"


def test_events_are_judged_in_their_order_and_within_a_time():
    done = expect(name="done", stream="events", field="event", event="done")
    after = {
        "name": "after",
        "stream": "events",
        "field": "event",
        "event": "burn",
        "after": "done",
    }

    late = judge(done, expect(**after, agents=("a",), within_s=3.0)).results[1]
    timely = judge(done, expect(**after, agents=("a",), within_s=4.0)).results[1]
    nothing = judge(done, expect(**after, agents=("b",))).results[1]

    assert (late.passed, late.got, late.limit) == (False, 9.0, 8.0)
    assert (timely.passed, timely.limit) == (True, 9.0)
    assert (nothing.passed, nothing.got) == (False, None)


def test_the_limit_of_an_event_is_what_it_is_held_to():
    """It may come past the last tick, and after another each agent has its own latest time."""
    burn = {"stream": "events", "field": "event", "event": "burn"}
    at_end = events_of("burn", t_s=[DURATION_S + 0.105])
    (alone,) = judge(expect(**burn, agents=("a",)), tables=at_end).results
    columns = {"a": ([10.0, 14.0], ["done", "burn"]), "b": ([50.0, 51.0], ["done", "burn"])}
    sources = {
        name: {"t_s": np.array(t_s), "event": objects(words), "details": objects([None] * 2)}
        for name, (t_s, words) in columns.items()
    }
    tables = {"events": FakeTable("events", EVENTS.fields, sources)}
    done = expect(name="done", stream="events", field="event", event="done")
    after = judge(done, expect(**burn, after="done", within_s=5.0), tables=tables).results[1]

    assert (alone.passed, alone.got, alone.limit) == (True, 100.105, 100.105)
    assert (after.passed, after.agent, after.got, after.limit) == (True, "a", 14.0, 15.0)


def events_of(*words, t_s=None):
    """Return events of agent a, all of one time if none are given."""
    times = objects([3.0] * len(words) if t_s is None else t_s)
    columns = {"t_s": times, "event": objects(words), "details": objects([None] * len(words))}
    return {"events": FakeTable("events", EVENTS.fields, {"a": columns})}


@pytest.mark.parametrize(("words", "passed"), [(("burn", "done"), False), (("done", "burn"), True)])
@pytest.mark.parametrize("rows", [1, 65_536])
def test_of_events_of_one_time_the_one_that_is_recorded_later_comes_after(
    words, passed, rows, monkeypatch
):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    common = {"stream": "events", "field": "event", "agents": ("a",)}
    done = expect(name="done", event="done", **common)
    first = ValueBounds.equals("done")
    seen = expect(
        name="seen", statistic="first_time", when=first, bounds=ValueBounds.below(9), **common
    )
    burn = expect(name="burn", event="burn", after="done", **common)

    by_event = judge(done, burn, tables=events_of(*words)).results[1]
    by_value = judge(seen, replace(burn, after="seen"), tables=events_of(*words)).results[1]

    assert (by_event.passed, by_value.passed) == (passed, passed)


@pytest.mark.parametrize("rows", [1, 65_536])
@pytest.mark.parametrize(
    ("t_s", "must", "passed"),
    [
        ([0.2, 0.1], "occur", True),
        ([0.2, 0.1], "not_occur", False),
        ([0.1, 0.2], "occur", False),
        ([0.1, 0.2], "not_occur", True),
    ],
)
def test_an_event_comes_after_another_by_its_time_however_early_it_was_recorded(
    t_s, must, passed, rows, monkeypatch
):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    common = {"stream": "events", "field": "event", "agents": ("a",)}
    armed = expect(name="armed", event="armed", **common)
    alarm = expect(name="alarm", event="alarm", must=must, after="armed", **common)

    found = judge(armed, alarm, tables=events_of("alarm", "armed", t_s=t_s)).results[1]

    assert found.passed == passed


@pytest.mark.parametrize(
    ("must", "to_s", "passed", "got"),
    [("not_occur", None, False, None), ("not_occur", 1.5, True, 0), ("occur", None, False, None)],
)
def test_an_event_that_occurs_too_often_to_be_followed_never_counts_as_absent(
    must, to_s, passed, got, monkeypatch
):
    monkeypatch.setattr(accumulators, "OCCURRENCES_KEPT", 2)
    common = {"stream": "events", "field": "event", "agents": ("a",)}
    words = ("burn", "burn", "done", "burn")
    tables = events_of(*words, t_s=[1.0, 2.0, 3.0, 4.0])
    done = expect(name="done", event="done", **common)
    after = expect(name="after", event="burn", after="done", must=must, to_s=to_s, **common)

    found = judge(done, after, tables=tables).results[1]

    assert (found.passed, found.got) == (passed, got)
    assert ("it occurs 3 times, and the first 2 are looked at" in found.expected) is (got is None)


def test_an_event_of_an_early_time_that_was_not_kept_may_be_the_one_that_must_not_be(monkeypatch):
    monkeypatch.setattr(accumulators, "OCCURRENCES_KEPT", 2)
    tables = events_of("burn", "burn", "burn", t_s=[8.0, 9.0, 1.0])
    common = {"stream": "events", "field": "event", "agents": ("a",)}

    found = judge(
        expect(name="none", event="burn", must="not_occur", to_s=5.0, **common), tables=tables
    ).results[0]

    assert (found.passed, found.got) == (False, None)


def test_an_event_may_come_after_that_of_one_other_agent():
    common = {"stream": "events", "field": "event", "event": "done"}
    first = expect(name="first", agents=("a",), **common)
    second = expect(name="second", agents=("b",), after="first", within_s=1.0, **common)

    found = judge(first, second).results[1]

    assert (found.got, found.passed) == (6.0, True)


def test_an_event_does_not_come_after_itself():
    common = {"stream": "events", "field": "event", "event": "burn", "agents": ("a",)}
    once = expect(name="once", **common)

    again = judge(once, expect(name="again", after="once", **common)).results[1]
    never = judge(once, expect(name="never", after="once", must="not_occur", **common)).results[1]
    alone = events_of("done", "burn", t_s=[1.0, 2.0])
    after = {"after": "once", **common}
    single = judge(once, expect(name="again", **after), tables=alone).results[1]
    none = judge(once, expect(name="never", must="not_occur", **after), tables=alone).results[1]

    assert (again.got, again.passed) == (9.0, True)
    assert (never.got, never.passed) == (1, False)
    assert (single.got, single.passed) == (None, False)
    assert (none.got, none.passed) == (0, True)


def test_what_is_recorded_before_time_runs_counts_as_time_0():
    early = {"t_s": np.array([-0.5, -0.1, 1.0]), "x_m": np.array([5.0, 6.0, 7.0])}
    tables = {"state": FakeTable("state", STATE.fields, {"a": early})}
    of_a = {"agents": ("a",), "from_s": 0.0}

    counted, least = judge(
        expect(name="c", statistic="count", bounds=ValueBounds.equals(3), **of_a),
        expect(name="m", statistic="min", bounds=ValueBounds.above(0), **of_a),
        tables=tables,
    ).results

    assert counted.passed
    assert (least.got, least.t_s) == (5.0, 0.0)


@pytest.mark.parametrize("rows", [1, 3, 65_536])
def test_a_rate_is_of_records_while_simulated_time_runs_alone(rows, monkeypatch):
    # As a device gives them in real time: on before the begin and beyond the end, where nothing says to_s.
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    t_s = np.append([np.nan, np.nan], np.arange(-1.0, DURATION_S + 1.0, 0.25))
    table = FakeTable("state", STATE.fields, {"a": {"t_s": t_s, "x_m": np.ones(len(t_s))}})

    found = judge(
        expect(name="r", statistic="rate", agents=("a",), bounds=ValueBounds.equals(4.0)),
        expect(name="c", statistic="count", agents=("a",), bounds=ValueBounds.above(0)),
        tables={"state": table},
    ).results

    assert [(each.got, each.passed) for each in found] == [(4.0, True), (len(t_s), True)]


@pytest.mark.parametrize("rows", [1, 2, 65_536])
def test_an_agent_that_was_started_anew_and_does_not_know_the_time_yet_starts_when_it_does(
    rows, monkeypatch
):
    monkeypatch.setattr(records, "BATCH_RECORDS", rows)
    words = ("start", "burn", "start", "done", "start")
    tables = events_of(*words, t_s=objects([None, 4.0, None, 6.5, None]))
    start = {"stream": "events", "field": "event", "event": "start", "agents": ("a",)}

    first, second, third = judge(
        expect(name="first", **start),
        expect(name="second", after="first", **start),
        expect(name="third", after="second", **start),
        tables=tables,
    ).results

    assert first.got == 0.0
    assert second.got == (4.0 if rows == 1 else 6.5), "as far as is read at a time"
    assert third.got == 6.5


@pytest.mark.parametrize("statistic", ["count", "rate", "first_time", "settled"])
def test_a_text_where_a_number_is_counted_holds_nothing(statistic):
    bounds, when = ValueBounds.below(1e9), ValueBounds.below(9.0)
    mixed = {"t_s": T_S[:3], "x_m": objects(["burn", 3.0, "done"])}
    tables = {"state": FakeTable("state", STATE.fields, {"a": mixed})}

    (result,) = judge(
        expect(statistic=statistic, when=when, bounds=bounds, agents=("a",)), tables=tables
    ).results

    wanted = {"count": 1, "rate": 1 / DURATION_S}.get(statistic, float(T_S[1]))
    assert result.got == wanted


def test_a_text_under_while_where_a_number_is_meant_holds_nothing():
    meanwhile = HeldBounds(stream="events", field="event", bounds=ValueBounds.above(3))

    result = result_of(statistic="count", bounds=ValueBounds.equals(0), meanwhile=meanwhile)

    assert result.passed


@pytest.mark.parametrize(
    ("held", "why"),
    [
        ({"stream": "nowhere"}, "nobody recorded stream nowhere"),
        ({"field": "y_m"}, "stream state has no field y_m"),
        ({"unit": "s"}, "state.x_m is in m"),
        ({"stream": "timeless", "field": "y"}, "records of stream timeless tell no time"),
    ],
)
def test_a_count_while_what_nobody_can_tell_holds_is_broken_with_the_reason(held, why):
    timeless = FakeTable("timeless", (Field("y", "m"),), {"a": {"y": T_S}})
    given = {"stream": "state", "field": "x_m", "bounds": ValueBounds.above(-1e9), **held}

    (result,) = judge(
        expect(statistic="count", bounds=ValueBounds.below(1), meanwhile=HeldBounds(**given)),
        tables={**TABLES, "timeless": timeless},
    ).results

    assert (result.got, result.passed) == (None, False)
    assert result.expected == f"x ({why})"


def test_what_events_carry_beside_their_fields_is_a_value_too():
    result = result_of(
        stream="events", field="dv_m_s", bounds=ValueBounds.below(2.0), agents=("a",)
    )

    assert (result.got, result.t_s, result.passed) == (2.5, 1.0, False)


def test_texts_are_counted_that_are_not_the_one_expected():
    result = result_of(
        stream="events", field="event", bounds=ValueBounds.equals("burn"), agents=("a",)
    )

    assert (result.got, result.limit, result.t_s, result.passed) == (2, 0.0, 0.0, False)


@pytest.mark.parametrize(
    "values",
    [
        {"stream": "nowhere"},
        {"field": "y_m"},
        {"agents": ("a", "c")},
        {"from_s": 99.999},
        {"stream": "nowhere", "statistic": "count", "bounds": ValueBounds.below(9.0)},
        {"stream": "nowhere", "event": "burn", "must": "not_occur"},
        {"unit": "kg"},
    ],
)
def test_what_never_came_is_broken(values):
    result = result_of(**({"bounds": ValueBounds.below(1e9)} | values))

    assert (result.got, result.passed) == (None, False)


@pytest.mark.parametrize(
    "statistic", ["each", "max", "min", "mean", "rms", "sd", "p99", "last", "settled"]
)
def test_nothing_but_nan_never_passes(statistic):
    nan = {"a": {"t_s": T_S, "x_m": np.full(len(T_S), np.nan)}}
    table = FakeTable("state", STATE.fields, nan)
    when = ValueBounds.below(math.inf)

    (result,) = judge(
        expect(statistic=statistic, when=when, bounds=ValueBounds.below(1e9), agents=("a",)),
        tables={"state": table},
    ).results

    assert (result.got, result.passed) == (None, False)


def test_a_stream_of_the_other_time_mode_is_not_judged_and_a_run_without_any_judged_has_a_gap():
    of_ticks = expect(name="ticks", stream="ticks", only_realtime=True)

    lockstep = judge(of_ticks)
    assert (lockstep.results, lockstep.gaps()) == (
        (),
        (
            "checks: none of 1 was judged, such as ticks: stream ticks is recorded in real time alone,"
            " and this run was in lockstep",
        ),
    )
    assert conclusion_of_expectations((), lockstep.gaps(), {})[0] == 5
    assert judge(of_ticks, is_lockstep=False).results[0].passed is False
    both = judge(of_ticks, expect(bounds=ValueBounds.below(1e9)))
    assert [each.name for each in both.results] == ["x"]
    assert both.gaps() == ()
    assert both.remarks()[0].startswith("ticks: not judged: ")


@pytest.mark.parametrize("run_code", [1, 3, 130])
@pytest.mark.parametrize(
    ("missing", "passed", "told"),
    [
        ((), True, "1 check holds"),
        ((), False, "CHECK BROKEN: x 1 (limit 2)"),
        (("host: no result",), True, "DATA INCOMPLETE: host: no result"),
    ],
)
def test_a_run_that_went_wrong_is_no_pass_whatever_holds_of_its_records(
    run_code, missing, passed, told
):
    result = CheckResult(name="x", limit=2.0, got=1.0, passed=passed)
    document = {"exit_code": run_code, "verdict": "FAILED: host: boom"}

    code, text = conclusion_of_expectations([result], missing, document)

    assert code == run_code
    assert text == f"FAILED: host: boom; judged by what it recorded: {told}"


@pytest.mark.parametrize("run_code", [0, 4, 5])
def test_a_run_that_ended_as_it_should_is_judged_by_the_expectations_alone(run_code):
    held = CheckResult(name="x", limit=2.0, got=1.0, passed=True)
    document = {"exit_code": run_code, "verdict": "CHECK BROKEN: another"}

    assert conclusion_of_expectations([held], (), document) == (0, "PASSED: 1 check holds")


@pytest.mark.parametrize(
    "asked",
    [
        {"stream": "events", "field": "event", "event": "burn", "must": "not_occur"},
        {"statistic": "count", "bounds": ValueBounds.below(5.0)},
        {"statistic": "rate", "bounds": ValueBounds.below(5.0)},
    ],
)
@pytest.mark.parametrize("from_s", [DURATION_S, 2 * DURATION_S])
def test_no_record_is_no_answer_for_a_time_that_was_never_flown(asked, from_s):
    (result,) = judge(expect(from_s=from_s, to_s=3 * DURATION_S, **asked)).results

    assert (result.got, result.passed) == (None, False)
    assert result.expected == f"x (the run ended at {DURATION_S:g} s, before its from_s)"


def test_a_time_that_was_flown_in_part_is_judged_with_a_remark():
    few = {"statistic": "count", "bounds": ValueBounds.below(1e9), "from_s": 20.0}

    over = judge(expect(**few, to_s=2 * DURATION_S))
    whole = judge(expect(**few, to_s=DURATION_S))

    assert over.results[0].passed and whole.results[0].passed
    assert over.remarks() == ("x: judged until 100 s, when the run ended, and not until 200 s",)
    assert whole.remarks() == ()


def test_what_comes_after_a_check_that_is_not_judged_is_not_judged_either():
    late = expect(name="late", stream="ticks", statistic="first_time", only_realtime=True)
    after = {"stream": "events", "field": "event", "event": "done"}

    found = judge(
        late,
        expect(name="then", after="late", **after),
        expect(name="last", after="then", **after),
        expect(name="ever", **after),
    )

    assert [each.name for each in found.results] == ["ever"]
    assert found.not_judged["then"] == "it comes after late, which is not judged"
    assert found.not_judged["last"] == "it comes after then, which is not judged"


GYRO = FakeTable(
    "device_imu.gyro",
    (Field("t_s", "s"), Field("gyro", "rad/s")),
    {
        "a/imu": {"t_s": np.array([1.0, 2.0, 6.0]), "gyro": np.array([0.5, -0.5, 2.0])},
        "pi2/imu": {"t_s": np.array([1.0, 2.0]), "gyro": np.array([0.0, 3.0])},
    },
    role="device",
)
HEALTH = FakeTable(
    "machine_health",
    (Field("monotonic_s", "s"), Field("cpu_percent", "%")),
    {"pi1": {"monotonic_s": np.array([900.0]), "cpu_percent": np.array([40.0])}},
    role="machine",
)


def test_records_of_devices_and_machines_are_judged_of_all_who_recorded_them_or_of_those_named():
    tables = {**TABLES, "device_imu.gyro": GYRO, "machine_health": HEALTH}
    of_gyro = {"stream": "imu.gyro", "field": "gyro", "bounds": ValueBounds.below(2.5)}
    held = HeldBounds(stream="imu.gyro", field="gyro", bounds=ValueBounds.above(0.0))

    results = judge(
        expect(name="all", agents=(), **of_gyro),
        expect(name="own", agents=("a/imu",), **of_gyro),
        expect(
            name="cpu",
            stream="health",
            field="cpu_percent",
            agents=(),
            bounds=ValueBounds.below(9.0),
        ),
        expect(
            name="none", stream="gps.fix", field="fix", agents=(), bounds=ValueBounds.below(9.0)
        ),
        expect(name="held", agents=("a",), statistic="count", field="", meanwhile=held),
        tables=tables,
    ).results

    assert [(each.name, each.agent, each.got, each.t_s, each.passed) for each in results[:4]] == [
        ("all", "pi2/imu", 3.0, 2.0, False),
        ("own", "a/imu", 2.0, 6.0, True),
        ("cpu", "pi1", 40.0, None, False),
        ("none", "", None, None, False),
    ]
    assert results[4].got == np.count_nonzero(((T_S >= 1.0) & (T_S < 2.0)) | (T_S >= 6.0))


def test_an_event_of_an_agent_may_come_after_one_of_its_device():
    events = FakeTable(
        "device_imu.events",
        EVENTS.fields,
        {
            "a/imu": {
                "t_s": np.array([4.0]),
                "event": objects(["lost"]),
                "details": objects([None]),
            }
        },
        role="device",
    )
    lost = expect(name="lost", stream="imu.events", field="event", event="lost", agents=("a/imu",))
    done = {"stream": "events", "field": "event", "event": "done", "agents": ("a",)}

    results = judge(
        lost,
        expect(name="soon", after="lost", within_s=2.0, **done),
        expect(name="sooner", after="lost", within_s=0.5, **done),
        tables={**TABLES, "device_imu.events": events},
    ).results

    assert [(each.got, each.passed) for each in results] == [(4.0, True), (5.0, True), (5.0, False)]


RADIO = FakeTable(
    "radio",
    (Field("t_s", "s"), Field("event", "", "str")),
    {
        "a": {"t_s": np.array([1.0, 2.0]), "event": objects(["refused", "sent"])},
        "b": {"t_s": np.array([3.0]), "event": objects(["\x1b[2Jheard"])},
    },
)


def remarks_on(tables=RADIO, **values):
    given = {"name": "calm", "stream": tables.name, "field": "event", "must": "not_occur"}
    return judge(expect(**(given | values)), tables={tables.name: tables}).remarks()


def test_a_word_that_must_not_occur_and_is_nowhere_is_told_with_those_that_are():
    assert remarks_on(event="refusd") == (
        "calm: no record of radio has 'refusd' in event, did you mean refused?",
    )
    assert remarks_on(event="lost") == (
        "calm: no record of radio has 'lost' in event; words seen: \\x1b[2Jheard, refused, sent",
    )


def test_a_word_that_is_counted_or_must_occur_is_told_likewise():
    count = {"must": "occur", "statistic": "count", "bounds": ValueBounds.below(1.0)}
    (told,) = remarks_on(**count, when=ValueBounds.equals("refusd"))

    assert told.endswith("has 'refusd' in event, did you mean refused?")
    assert remarks_on(**count, when=ValueBounds.equals("refused")) == ()
    assert len(remarks_on(event="lost", must="occur")) == 1


def test_a_word_that_is_there_or_could_not_be_otherwise_is_no_remark():
    assert remarks_on(event="refused") == ()
    assert remarks_on(event="refused", from_s=1.5) == (), "it is a word of the stream"
    assert remarks_on(EVENTS, event="lost") == (), "validate knows the words of events"
    assert remarks_on(event="lost", has_known_words=True) == (), "as declared"
    nothing = FakeTable("radio", RADIO.fields, {"a": {"t_s": np.array([]), "event": objects([])}})
    assert remarks_on(nothing, event="lost") == ()


def test_a_word_that_other_agents_have_is_not_misspelt():
    assert remarks_on(event="sent", agents=("b",)) == ()
    (told,) = remarks_on(event="snt", agents=("b",))

    assert told.endswith("did you mean sent?")


def test_of_very_many_words_few_are_told():
    words = [f"word{number:04d}" for number in range(5000)]
    many = {"a": {"t_s": np.arange(5000.0), "event": objects(words)}}
    (told,) = remarks_on(FakeTable("radio", RADIO.fields, many), event="quiet")

    assert told.count("word0") == 10
    assert told.endswith(" and more"), "how many more there are nobody has counted"


def test_a_word_that_comes_after_very_many_others_is_there():
    words = [f"word{number}" for number in range(150_000)]
    many = {"a": {"t_s": np.arange(150_001.0), "event": objects([*words, "quiet"])}}

    assert remarks_on(FakeTable("radio", RADIO.fields, many), event="quiet") == ()


def test_records_about_names_that_are_no_agents_are_told_by_checks_that_leave_them_out():
    about = ["a", "b", "bus-1", "bus-1", "swing"]
    host = FakeTable(
        "host_slots",
        HOST.fields,
        {
            "host": {
                "t_s": np.arange(5.0),
                "agent": objects(about),
                "error_deg": np.arange(5.0),
            }
        },
        role="host",
    )
    own = {"stream": "slots", "field": "error_deg", "is_of_host": True}
    bounds = ValueBounds(high=2.0)
    of_agents = [expect(name=name, bounds=bounds, **own) for name in ("x", "y")]
    of_all = expect(name="z", agents=("host",), bounds=bounds, **own)

    found = judge(*of_agents, of_all, tables={"host_slots": host})

    assert [each.passed for each in found.results] == [True, True, False]
    assert found.remarks() == (
        "stream slots: 3 records about bus-1, swing, which are no agents of the run, are not judged by x, y;"
        " agents: [host] judges every record",
    )
    assert judge(of_all, tables={"host_slots": host}).remarks() == ()
    assert judge(*of_agents, tables=TABLES).remarks() == ()


def test_of_a_condition_that_agents_and_the_host_record_an_agents_own_records_count():
    fields = (Field("t_s", "s"), Field("x_m", "m"))
    own = FakeTable("mode", fields, {"a": {"t_s": np.array([0.0]), "x_m": np.array([1.0])}})
    columns = {"t_s": np.array([0.0, 50.0]), "x_m": np.array([-1.0, 1.0])}
    columns["agent"] = objects(["a", "b"])
    by_host = (*fields, Field("agent", "", "str"))
    host = FakeTable("host_mode", by_host, {"host": columns}, role="host")
    held = HeldBounds(stream="mode", field="x_m", bounds=ValueBounds.above(0.0))
    counted = expect(statistic="count", bounds=ValueBounds.above(0.0), meanwhile=held)

    results = [
        judge(replace(counted, agents=(agent,)), tables={**TABLES, "mode": own, "host_mode": host})
        for agent in ("a", "b")
    ]

    assert [each.results[0].got for each in results] == [len(T_S), len(T_S) / 2]
