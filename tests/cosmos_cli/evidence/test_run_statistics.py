import numpy as np
import pytest

from cosmos_cli.evidence.statistics import (
    AgentTicks,
    TickStatistics,
    TickTotals,
    tick_statistics,
    tick_totals,
    with_told_misses,
)
from madns_runtime.analysis.distribution import Distribution, summarise


def agent(run, missed=0):
    return AgentTicks(run=run, missed=missed, lateness_ms={}, margin_ms={})


@pytest.mark.parametrize("parts", [1, 7])
def test_distribution_tells_what_numpy_tells_of_all_samples(parts):
    samples = np.random.default_rng(5).gamma(2.0, 60.0, 10_001).astype(np.int64)
    distribution = Distribution()

    for part in np.array_split(samples, parts):
        distribution.add(Distribution.of(part))
    summary = distribution.summary(1e-3)

    expected = np.percentile(samples, (50, 99, 99.9, 1, 0.1)) / 1000
    got = [summary.p50, summary.p99, summary.p999, summary.p01, summary.p001]
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    np.testing.assert_allclose(summary.mean, samples.mean() / 1000, rtol=1e-12)
    np.testing.assert_allclose(summary.sd, samples.std() / 1000, rtol=1e-12)
    assert (summary.count, summary.min, summary.max) == (
        10_001,
        samples.min() * 1e-3,
        samples.max() * 1e-3,
    )


def test_what_is_not_finite_is_no_sample():
    summary = summarise(np.array([1.0, np.nan, 3.0, np.inf]))

    assert (summary.count, summary.mean) == (2, 2.0)
    assert summarise(np.array([np.nan])) is None
    assert summarise(np.array([])) is None


def test_single_sample_is_every_quantile():
    summary = summarise(np.array([4.0]))

    assert {summary.p50, summary.p999, summary.p001, summary.min, summary.max} == {4.0}
    assert (summary.sd, summary.range) == (0.0, 0.0)


def test_agent_that_died_has_missed_what_was_due_of_it():
    totals = tick_totals({"a": agent(100), "b": agent(40)}, {}, agents=("a", "b"), due_each=100)

    assert (totals.due, totals.run, totals.missed) == (200, 140, 60)


def test_ticks_that_never_ran_count_as_missed_although_no_record_shows_them():
    counters = {"a": {"due": 100, "run": 90, "overrun_errors": 3}}

    totals = tick_totals({"a": agent(90)}, counters, agents=("a",), due_each=None)

    assert (totals.miss_ratio, totals.overrun_ratio) == (0.1, 0.03)


def test_records_that_were_dropped_are_no_missed_ticks():
    counters = {"a": {"due": 100, "run": 100}}

    assert tick_totals({"a": agent(70)}, counters, agents=("a",), due_each=100).missed == 0


def test_rejoined_agent_has_missed_the_time_between():
    counters = {"a": {"due": 50, "run": 50}}

    totals = tick_totals({"a": agent(80)}, counters, agents=("a",), due_each=100)

    assert totals.missed == 20


def test_what_an_agent_missed_last_counts_also_of_one_that_was_away_on_purpose():
    """No tick follows these, and what ran before it was away hides them from its summary."""
    recorded = TickStatistics(agents={"a": agent(880)}, lateness_ms={}, margin_ms={})
    counters = {"a": {"due": 1000, "run": 400, "missed": 100, "not_run": 500}}

    totals = tick_totals(
        with_told_misses(recorded, {"a": 100}).agents,
        counters,
        agents=("a",),
        due_each=1000,
        excused=("a",),
    )

    assert (totals.run, totals.missed) == (880, 100)


def test_an_agent_that_never_ran_a_tick_stands_among_the_others_with_what_it_missed():
    recorded = TickStatistics(agents={"a": agent(40), "c": agent(40)}, lateness_ms={}, margin_ms={})

    agents = with_told_misses(recorded, {"b": 40}).agents

    assert [(name, of.run, of.missed) for name, of in agents.items()] == [
        ("a", 40, 0),
        ("b", 0, 40),
        ("c", 40, 0),
    ]


class Ticks:
    """The ticks of one agent, of all its incarnations, as a table."""

    margin_us = np.array([100, -4_000, -6_000, -7_000])

    def has(self, *names):
        return True

    def each(self, names):
        zeros = np.zeros_like(self.margin_us)
        yield "a", {"lateness_us": zeros, "margin_us": self.margin_us, "missed": zeros}


@pytest.mark.parametrize(("overrun_ms", "errors"), [(5.0, 2), (6.0, 1), (None, 0)])
def test_steps_that_overran_before_a_restart_stay_counted(overrun_ms, errors):
    recorded = tick_statistics(Ticks(), overrun_ms).agents
    last_incarnation = {"a": {"due": 2, "run": 2, "overrun_errors": 0}}

    totals = tick_totals(recorded, last_incarnation, agents=("a",), due_each=4)

    assert totals.overrun_errors == totals.agents["a"].overrun_errors == errors


def test_ratio_of_nothing_is_not_measured():
    assert TickTotals(due=0, run=0, overrun_errors=0).miss_ratio is None
