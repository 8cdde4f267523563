"""When entries of a timeline are due: at, every, by chance under the seed, within the run and bounded."""

import math

import pytest

from madns_runtime.timeline.entries import ScheduledEntry
from madns_runtime.timeline.schedule import ACTIONS_MAX, count_expected, schedule


def times(
    *entries: ScheduledEntry, seed: int = 1, duration_s: float = 100.0
) -> list[tuple[float, int]]:
    return [(due.t_s, due.entry) for due in schedule(entries, seed=seed, duration_s=duration_s)]


def test_entries_are_due_by_time_and_at_one_time_in_their_order() -> None:
    every = ScheduledEntry(action="a", every_s=20.0, from_s=10.0, to_s=50.0)
    at = ScheduledEntry(action="b", at_s=30.0)

    assert times(at, every) == [(10.0, 1), (30.0, 0), (30.0, 1), (50.0, 1)]


def test_the_end_of_the_run_is_no_time_for_an_action() -> None:
    assert times(ScheduledEntry(action="a", at_s=100.0)) == []
    assert times(ScheduledEntry(action="a", every_s=50.0)) == [(0.0, 0), (50.0, 0)]


@pytest.mark.parametrize("tick_hz", [1, 2, 5, 10, 20, 50, 100])
def test_a_period_that_is_no_binary_number_meets_its_ticks_and_its_last_time(tick_hz: int) -> None:
    for last in (3, 6, 7, 12, 1234):
        every = ScheduledEntry(action="a", every_s=1 / tick_hz, to_s=last / tick_hz)

        found = times(every, duration_s=10_000.0)

        assert found[:13] == [(number / tick_hz, 0) for number in range(min(last + 1, 13))]
        assert count_expected(every, 10_000.0) == last + 1
    tenths = times(ScheduledEntry(action="a", every_s=0.1, from_s=0.1), duration_s=400.0)
    assert [t_s for t_s, _ in tenths] == [number / 10 for number in range(1, 4000)]


def test_a_condition_has_no_time_beforehand() -> None:
    assert times(ScheduledEntry(action="a", condition=0)) == []


def test_rates_are_drawn_under_the_seed_for_each_agent_alone() -> None:
    agents = ("agent-1", "agent-2")
    entry = ScheduledEntry(action="hang", rate_per_h=100.0, agents=agents)
    alone = ScheduledEntry(action="hang", rate_per_h=100.0, agents=("agent-2",))

    first = schedule([entry], seed=1, duration_s=36_000.0)
    other = schedule([entry], seed=2, duration_s=36_000.0)

    assert first == schedule([entry], seed=1, duration_s=36_000.0) != other
    assert [due.t_s for due in first if due.agents == ("agent-2",)] == [
        due.t_s for due in schedule([alone], seed=1, duration_s=36_000.0)
    ]
    assert all(0.0 <= due.t_s < 36_000.0 for due in first)
    assert len(first) == pytest.approx(2000, abs=5 * 2000**0.5)  # Poisson: five sigma


def test_rates_keep_to_their_window_and_count_as_expected() -> None:
    entry = ScheduledEntry(
        action="hang", rate_per_h=3600.0, from_s=20.0, to_s=40.0, agents=("a", "b")
    )

    found = times(entry)

    assert found and all(20.0 <= t_s < 40.0 for t_s, _ in found)
    assert count_expected(entry, 100.0) == pytest.approx(40.0)
    assert count_expected(ScheduledEntry(action="a", every_s=20.0, from_s=10.0), 100.0) == 5


def test_the_number_of_actions_is_bounded() -> None:
    assert len(times(ScheduledEntry(action="a", every_s=1e-3))) == ACTIONS_MAX


def test_a_period_next_to_nothing_is_more_actions_than_can_be_counted() -> None:
    assert count_expected(ScheduledEntry(action="a", every_s=5e-324), 100.0) == math.inf
