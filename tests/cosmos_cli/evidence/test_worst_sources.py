"""Whose value decided a check of all."""

from pathlib import Path

from cosmos_cli.evidence.statistics import TickTotals, worst_sources
from cosmos_cli.evidence.streams import RecordFile, StreamScan


def scan(source, **counts):
    file = RecordFile(
        path=Path("x"), role="agent", source=source, stream="s", incarnation=1, fields=()
    )
    told = {"records": 1, "promised": 1, **counts}
    return StreamScan(file=file, size_bytes=1, sha256="", **told)


def ticks(**missed):
    return {
        name: TickTotals(due=100, run=100 - count, overrun_errors=0)
        for name, count in missed.items()
    }


def test_agent_that_missed_most_and_stream_that_lost_most_are_named():
    found = worst_sources(
        ticks(a=1, b=7, c=2),
        {"a": {"messages": {"sync": {"lost": 2}}}, "b": {"messages": {}}},
        [scan("a", dropped=1), scan("b", dropped=5, not_finite=60), scan("c", promised=None)],
    )

    assert found == {
        "deadline.miss_ratio": "b",
        "messages.sync.lost": "a",
        "records.dropped": "b/s",
        "records.not_finite": "b/s",
        "records.truncated": "c/s",
    }


def test_others_with_the_same_are_counted():
    assert worst_sources(ticks(a=7, b=7, c=7), {}, []) == {"deadline.miss_ratio": "a and 2 more"}


def test_nobody_is_named_where_nothing_is_wrong():
    assert worst_sources(ticks(a=0, b=0), {"a": {"messages": 3}}, [scan("a")]) == {}


def test_what_was_lost_on_purpose_is_nobodys_worst():
    agents = {"a": {"ended_on_purpose": [1]}}

    assert worst_sources({}, agents, [scan("a", promised=None, dropped=3)]) == {}


def test_messages_to_and_from_a_lost_agent_are_nobodys_worst_as_their_sum_leaves_them_out():
    lost = {"state": "lost", "messages": {"sync": {"lost": 3}}}
    stopped = {"state": "stopped", "messages": {"sync": {"lost": 1}}}

    assert worst_sources({}, {"a": lost}, []) == {}
    assert worst_sources({}, {"a": lost, "b": stopped}, []) == {"messages.sync.lost": "b"}
