import sys
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from madns_runtime.simulations.counter import round_trips as module
from madns_runtime.simulations.counter.agent import CounterAgent
from madns_runtime.simulations.counter.parameters import CounterParameters
from madns_runtime.simulations.counter.round_trips import COUNTED_US, RoundTrips


class Context:
    """What the framework gives an agent, with a clock that moves when told."""

    def __init__(self):
        self.parameters = CounterParameters()
        self.time_s = 0.0
        self.sent = []
        self.records = []
        self.open_stream = lambda name, fields: None
        self.record = lambda name, values: self.records.append(values)
        self.send = lambda to, message, service: self.sent.append(message)

    def now_s(self):
        return self.time_s


@pytest.fixture
def context():
    return Context()


@pytest.fixture
def agent(context):
    made = CounterAgent()
    made.setup(context, {})
    return made


def play(agent, context, *, packet, round_trip_s):
    agent.step(SimpleNamespace(index=packet))
    _, value, payload = context.sent[-1]
    context.time_s += round_trip_s
    agent.receive([packet, value + 1, payload])


def expected(samples):
    p50, p99, p999 = np.percentile(samples, (50, 99, 99.9))
    low, high = samples.min(), samples.max()
    return {
        "mean": samples.mean(),
        "sd": samples.std(),
        "min": low,
        "max": high,
        "range": high - low,
        "p50": p50,
        "p99": p99,
        "p999": p999,
    }


@pytest.mark.parametrize("scale_us", [5, 300, 60_000, 500_000])
def test_statistics_are_those_of_all_samples(scale_us):
    samples = np.random.default_rng(scale_us).gamma(2.0, scale_us, 4000).astype(int)
    trips = RoundTrips()
    for sample in samples.tolist():
        trips.add(sample)

    assert trips.statistics() == pytest.approx(expected(samples), rel=1e-9, abs=1e-3)
    assert trips.left_out == 0


def test_values_on_both_sides_of_the_array_are_counted():
    samples = np.array([-3, 0, COUNTED_US - 1, COUNTED_US, COUNTED_US, 10**9])
    trips = RoundTrips()
    for sample in samples.tolist():
        trips.add(sample)

    assert trips.statistics() == pytest.approx(expected(samples), abs=1e-3)


def test_nothing_counted_has_no_statistics():
    assert RoundTrips().statistics() is None


def test_long_values_beyond_the_bound_are_left_out_and_said(monkeypatch):
    monkeypatch.setattr(module, "LONG_VALUES_MAX", 3)
    trips = RoundTrips()
    for value in (100_000, 200_000, 300_000, 400_000, 100_000, 500_000):
        trips.add(value)

    figures = trips.statistics()
    assert trips.left_out == 2
    assert figures is not None
    assert (figures["min"], figures["max"], figures["mean"]) == (100_000, 300_000, 175_000)


def test_memory_stays_below_a_megabyte_however_many_values_there_are():
    tracemalloc.start()
    try:
        trips = RoundTrips()
        for value in range(0, 40 * module.LONG_VALUES_MAX, 2):
            trips.add(COUNTED_US + value)
        kept, _ = tracemalloc.get_traced_memory()
        trips.statistics()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert kept < 1_000_000
    assert peak < 2_000_000
    assert sys.getsizeof(trips._counts) < 300_000


def test_agent_counts_returns_apart_from_what_the_statistics_hold(agent, context, monkeypatch):
    monkeypatch.setattr(module, "LONG_VALUES_MAX", 1)
    for packet, round_trip_s in enumerate((0.0002, 0.2, 0.3, 0.4)):
        play(agent, context, packet=packet, round_trip_s=round_trip_s)

    summary = agent.finish()

    assert (summary["sent"], summary["returned"], summary["lost"]) == (4, 4, 0)
    assert summary["round_trips_left_out"] == 2
    assert summary["round_trip_us"]["max"] == 200_000
    assert all(check["passed"] for check in summary["checks"])


def test_agent_counts_lost_repeated_and_overtaken_packets(agent, context):
    for packet in range(4):
        agent.step(SimpleNamespace(index=packet))
    context.time_s += 0.001
    for packet, value in ((1, 3), (0, 2), (1, 3), (3, 5)):
        agent.receive([packet, value, b""])

    summary = agent.finish()

    assert (summary["sent"], summary["returned"], summary["lost"]) == (4, 3, 1)
    assert (summary["duplicated"], summary["out_of_order"], summary["wrong_values"]) == (1, 1, 0)
    assert summary["round_trip_us"]["p50"] == 1000.0
    assert [record[2] for record in context.records] == [1000, 1000, 1000]
