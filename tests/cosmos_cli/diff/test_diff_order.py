"""Streams whose records do not stand in the order of their times: each record finds its partner all the same."""

from types import SimpleNamespace

import numpy as np
import pytest

from cosmos_cli.diff import stream
from cosmos_cli.diff.stream import choose_pairing, diff_stream
from madns_runtime.analysis import matching
from madns_runtime.recording.records import Field

FIELDS = (Field("t_s", "s"), Field("agent", "", "str"), Field("x_m", "m"))
HZ = (10.0, 10.0)


def recorded(records, fields=FIELDS, size=50):
    """Return a host's stream of (time, agent) that is read some records at a time; x tells which record it is."""
    chunks = [records[start : start + size] for start in range(0, len(records), size)]

    def batches(names):
        for chunk in chunks:
            times, agents = zip(*chunk, strict=True)
            own = np.empty(len(chunk), dtype=object)
            own[:] = agents
            x_m = np.array([hash(one) % 1000 for one in chunk], dtype=float)
            columns = {"t_s": np.array(times), "agent": own, "x_m": x_m}
            yield {name: columns[name] for name in names}

    names = tuple(field.name for field in fields)
    return SimpleNamespace(
        table="histories",
        source="host",
        role="host",
        fields=fields,
        files=(),
        names=lambda: names,
        batches=batches,
    )


def diff(first, second, fields=FIELDS):
    a, b = recorded(first, fields), recorded(second, fields)
    pairing = choose_pairing(a.fields, b.fields, HZ)
    found = diff_stream(a, b, pairing, agents=())
    assert (found.rows_a, found.rows_b) == (len(first), len(second))
    return found.matched, found.only_a.count, found.only_b.count, found.has_same_values


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(stream, "ROWS_READ_MAX", 100)


def history(agent, count, first=0):
    return [(round(0.1 * tick, 1), agent) for tick in range(first, count)]


def histories(count, *, of_first=None):
    """Return what a host records at the end: one agent's history after the other's."""
    agents = [f"agent-{number:02d}" for number in range(20)]
    return sum((history(a, of_first if a == agents[0] and of_first else count) for a in agents), [])


def test_histories_written_one_after_the_other_lose_what_is_missing_alone():
    assert diff(histories(300), histories(300, of_first=290)) == (5990, 10, 0, False)
    assert diff(histories(300, of_first=290), histories(300)) == (5990, 0, 10, False)
    assert diff(histories(300), histories(300)) == (6000, 0, 0, True)


def test_a_stream_that_goes_back_long_after_its_first_batch_is_read_again_in_its_order():
    ascending = history("a", 3000)
    late = history("b", 3000)

    assert diff(ascending + late, ascending + late[:-5]) == (5995, 5, 0, False)


def test_agents_in_another_order_are_found():
    other = history("b", 900) + history("a", 900)

    assert diff(history("a", 900) + history("b", 900), other) == (1800, 0, 0, True)


def test_times_that_start_anew_without_a_word_of_whose_they_are_are_found():
    fields = (FIELDS[0], FIELDS[2])
    twice = history("a", 700) + history("a", 700)

    assert diff(twice, twice, fields) == (1400, 0, 0, True)


@pytest.mark.parametrize("seed", range(5))
def test_records_in_any_order_are_matched_as_those_in_order_are(seed):
    random = np.random.default_rng(seed)
    records = sorted(histories(60), key=lambda record: record[0])
    a = [records[index] for index in random.permutation(len(records))[:1100]]
    b = [records[index] for index in random.permutation(len(records))[:1100]]
    common = len(set(a) & set(b))

    assert diff(a, b)[:3] == (common, 1100 - common, 1100 - common)


def test_histories_are_held_in_small_part(monkeypatch):
    held = []
    settle = matching._settle

    def watched(a, b, *more):
        held.append(len(a.held) + len(b.held))
        return settle(a, b, *more)

    monkeypatch.setattr(matching, "_settle", watched)

    assert diff(histories(1000), histories(1000, of_first=900))[0] == 19_900
    # Two batches, and what has no partner until its whole agent is read.
    assert max(held) <= 700


def test_what_waits_for_others_is_bounded(monkeypatch):
    monkeypatch.setattr(matching, "ROWS_HELD_MAX", 1000)
    first = history("a", 3000) + history("b", 3000)
    second = history("b", 3000) + history("a", 3000)

    matched, only_a, only_b, _ = diff(first, second)

    assert matched + only_a == matched + only_b == 6000
    assert only_a > 0
