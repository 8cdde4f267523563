import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from madns_runtime.errors import ConfigurationError, IllegalTransition
from madns_runtime.timing.rate import (
    LatenessHistogram,
    Pacer,
    RealTimeFactor,
    TickTiming,
    count_ticks,
    has_tick_from,
    last_period_s,
    staggered,
)


def make_pacer(tick_hz=10.0, phase_s=0.0, duration_s=1.0, overrun_s=0.005):
    return Pacer(tick_hz=tick_hz, phase_s=phase_s, duration_s=duration_s, overrun_s=overrun_s)


def run_tick(pacer, begin_s, end_s):
    timing = pacer.begin(begin_s)
    assert timing is not None
    return timing, pacer.end(end_s)


@pytest.mark.parametrize(
    ("tick_hz", "duration_s", "expected"),
    [
        (10.0, 1.0, 10),
        (10.0, 0.7, 7),  # 10 * 0.7 is 7.000000000000001
        (10.0, 0.3, 3),
        (3.0, 1.0, 3),
        (100.0, 0.29, 29),  # 100 * 0.29 is 28.999999999999996
        (10.0, 0.71, 8),
        (10.0, 0.69, 7),
        (1.0, 0.001, 1),
        (1.0, 1e-12, 1),
        (100.0, 86_400.0, 8_640_000),
        (1e-3, 4000.0, 4),
        (100.0, 1e7, 1_000_000_000),
        (10_000.0, 315_576_000.0, 3_155_760_000_000),  # the fastest rate for the longest run
        (33.3, 0.3, 10),  # 9.99
        (0.3, 10.0, 3),
        (10.0, 0.7 + 1e-7, 8),  # a tick of its own
        (10.0, 0.7 + 1e-12, 7),
    ],
)
def test_tick_count_is_robust_to_rounding(tick_hz, duration_s, expected):
    assert count_ticks(duration_s, tick_hz) == expected
    assert make_pacer(tick_hz=tick_hz, duration_s=duration_s).tick_count == expected


def test_a_run_that_is_stopped_at_its_begin_has_no_tick():
    assert count_ticks(0.0, 10.0) == 0


@given(
    rate=st.fractions(min_value=1, max_value=1000, max_denominator=60),
    count=st.integers(min_value=1, max_value=100_000),
)
@settings(derandomize=True)
def test_duration_of_whole_ticks_holds_exactly_that_many(rate, count):
    pacer = make_pacer(tick_hz=float(rate), duration_s=float(count / rate))

    assert pacer.tick_count == count


@pytest.mark.parametrize(
    "arguments",
    [
        {"tick_hz": 0.0},
        {"tick_hz": -1.0},
        {"tick_hz": math.inf},
        {"tick_hz": math.nan},
        {"duration_s": 0.0},
        {"duration_s": math.inf},
        {"overrun_s": -1e-9},
        {"phase_s": -0.01},
        {"phase_s": 0.1},
    ],
)
def test_arguments_out_of_range_are_refused(arguments):
    with pytest.raises(ConfigurationError):
        make_pacer(**arguments)


def test_ticks_that_are_kept_are_neither_late_nor_missed():
    pacer = make_pacer(tick_hz=4.0, duration_s=1.0)
    seen = []

    while (deadline_s := pacer.next_deadline_s()) is not None:
        seen.append(pacer.begin(deadline_s))
        assert pacer.end(deadline_s + 0.125) == 0.125

    assert seen == [TickTiming(k, k / 4, k / 4, 0.0, 0) for k in range(4)]
    assert pacer.begin(100.0) is None
    assert pacer.summary() == {
        "due": 4,
        "run": 4,
        "missed": 0,
        "not_run": 0,
        "overrun_warnings": 0,
        "overrun_errors": 0,
        "lateness_us_p50": 0,
        "lateness_us_p99": 0,
        "lateness_us_max": 0,
        "margin_us_min": 125_000,
    }


def test_tick_is_not_begun_before_its_deadline():
    pacer = make_pacer(phase_s=0.03)

    assert pacer.begin(-math.inf) is None
    assert pacer.begin(0.0299) is None
    assert pacer.begin(0.03) is not None
    assert pacer.summary()["run"] == 1


def test_phase_moves_the_deadline_and_not_the_simulated_time():
    pacer = make_pacer(phase_s=0.03)
    run_tick(pacer, 0.03, 0.04)

    timing, margin_s = run_tick(pacer, 0.135, 0.16)

    assert timing.index == 1
    assert timing.t_s == 0.1
    assert timing.deadline_s == pytest.approx(0.13)
    assert timing.lateness_s == pytest.approx(0.005)
    assert margin_s == pytest.approx(0.07)


def test_late_wakeup_does_not_move_later_deadlines():
    pacer = make_pacer(tick_hz=100.0, duration_s=100.0)

    for index in range(10_000):
        timing, _ = run_tick(pacer, index / 100 + 0.004, index / 100 + 0.006)
        assert timing.deadline_s == index / 100


def test_tick_late_by_less_than_a_period_is_run():
    pacer = make_pacer()

    timing, _ = run_tick(pacer, 0.0999, 0.0999)

    assert (timing.index, timing.missed) == (0, 0)


def test_deadlines_passed_by_a_whole_period_are_missed_and_the_newest_due_is_run():
    pacer = make_pacer()
    run_tick(pacer, 0.0, 0.01)

    timing, _ = run_tick(pacer, 0.45, 0.46)

    assert (timing.index, timing.missed) == (4, 3)
    assert timing.lateness_s == pytest.approx(0.05)
    assert pacer.next_deadline_s() == 0.5
    assert pacer.missed == 3


def test_deadline_passed_by_exactly_one_period_is_missed():
    pacer = make_pacer(tick_hz=4.0)

    timing, _ = run_tick(pacer, 0.25, 0.25)

    assert (timing.index, timing.missed, timing.lateness_s) == (1, 1, 0.0)


def test_wakeup_after_the_end_misses_all_that_was_left():
    pacer = make_pacer()
    run_tick(pacer, 0.0, 0.01)

    timing = pacer.begin(7.0)

    assert timing is None
    assert pacer.next_deadline_s() is None
    assert pacer.summary()["missed"] == 9


def test_wakeup_long_after_any_end_is_told_at_once():
    """So late that one more tick changes no digit of the time."""
    pacer = make_pacer()

    assert pacer.begin(1e300) is None
    assert pacer.summary()["missed"] == 10


def test_last_tick_is_run_while_its_period_lasts():
    pacer = make_pacer()

    timing, margin_s = run_tick(pacer, 0.99, 1.02)

    assert (timing.index, timing.missed) == (9, 9)
    assert margin_s == pytest.approx(-0.02)


@pytest.mark.parametrize(
    ("end_s", "warnings", "errors"),
    [
        (0.2499, 0, 0),
        (0.25, 0, 0),
        (0.2501, 1, 0),
        (0.2578125, 1, 0),
        (0.258, 0, 1),
        (9.0, 0, 1),
    ],
)
def test_overrun_is_a_warning_up_to_the_tolerance_and_an_error_beyond(end_s, warnings, errors):
    pacer = make_pacer(tick_hz=4.0, overrun_s=0.0078125)

    _, margin_s = run_tick(pacer, 0.0, end_s)

    assert margin_s == pytest.approx(0.25 - end_s)
    assert (pacer.overrun_warnings, pacer.overrun_errors) == (warnings, errors)


def test_smallest_margin_is_kept():
    pacer = make_pacer()
    for index, end_s in enumerate((0.05, 0.1125, 0.25)):
        run_tick(pacer, index / 10, end_s)

    assert pacer.summary()["margin_us_min"] == 50_000
    run_tick(pacer, 0.3, 0.4015)
    assert pacer.summary()["margin_us_min"] == pytest.approx(-1500, abs=1)


def test_margin_is_unknown_before_a_step_ended():
    assert make_pacer().summary()["margin_us_min"] is None


def test_begin_within_a_step_is_illegal_and_changes_nothing():
    pacer = make_pacer()
    pacer.begin(0.0)
    before = pacer.summary()

    with pytest.raises(IllegalTransition, match="tick 0 has not ended"):
        pacer.begin(0.1)

    assert pacer.summary() == before
    assert pacer.end(0.05) == pytest.approx(0.05)


def test_end_without_a_step_is_illegal():
    pacer = make_pacer()

    with pytest.raises(IllegalTransition, match="no tick has begun"):
        pacer.end(0.0)

    run_tick(pacer, 0.0, 0.01)
    with pytest.raises(IllegalTransition):
        pacer.end(0.02)


def test_agent_that_joins_late_starts_with_the_first_tick_not_yet_due():
    pacer = make_pacer()

    skipped = pacer.skip_to(0.42)
    timing, _ = run_tick(pacer, 0.5, 0.51)

    assert skipped == 5
    assert (timing.index, timing.missed) == (5, 0)
    assert pacer.summary()["not_run"] == 5
    assert pacer.summary()["missed"] == 0


@pytest.mark.parametrize(
    ("now_s", "expected"), [(-3.0, 0), (0.0, 0), (0.01, 1), (0.25, 1), (0.26, 2)]
)
def test_joining_at_a_deadline_still_runs_its_tick(now_s, expected):
    pacer = make_pacer(tick_hz=4.0)

    assert pacer.skip_to(now_s) == expected
    assert pacer.next_deadline_s() == expected / 4


def test_joining_after_the_end_leaves_nothing_to_run():
    pacer = make_pacer()

    pacer.skip_to(50.0)
    pacer.finish(50.0)

    assert pacer.next_deadline_s() is None
    assert pacer.summary()["not_run"] == 10
    assert pacer.summary()["missed"] == 0


def test_ticks_never_run_at_the_end_are_missed():
    pacer = make_pacer()
    run_tick(pacer, 0.0, 0.01)

    pacer.finish(5.0)
    pacer.finish(5.0)

    assert pacer.summary()["missed"] == 9
    assert pacer.summary()["due"] == 10


def test_run_cut_short_misses_only_what_was_due():
    pacer = make_pacer()
    run_tick(pacer, 0.0, 0.01)

    pacer.finish(0.35)

    assert pacer.summary()["missed"] == 3
    assert pacer.summary()["due"] == 4


def test_step_that_never_ended_can_be_closed():
    pacer = make_pacer(duration_s=0.1)
    pacer.begin(0.0)

    pacer.finish(1.0)

    assert pacer.summary()["run"] == 1
    assert pacer.summary()["missed"] == 0


@given(
    tick_hz=st.floats(min_value=0.5, max_value=5000),
    share=st.floats(min_value=0, max_value=0.99),
    count=st.integers(min_value=1, max_value=400),
    seed=st.integers(min_value=0, max_value=2**32),
)
@settings(derandomize=True, max_examples=150)
def test_every_due_tick_is_run_missed_or_not_run_and_none_twice(tick_hz, share, count, seed):
    chance = random.Random(seed)
    pacer = make_pacer(tick_hz=tick_hz, phase_s=share / tick_hz * 0.99, duration_s=count / tick_hz)
    now_s = chance.uniform(-1, 3) / tick_hz
    not_run = pacer.skip_to(now_s)
    indices = []
    missed = 0

    while (deadline_s := pacer.next_deadline_s()) is not None:
        now_s = max(now_s, deadline_s) + chance.choice((0.0, 0.1, 0.9, 3.3)) / tick_hz
        timing = pacer.begin(now_s)
        if timing is None:
            break
        assert timing.deadline_s <= now_s < timing.deadline_s + 1.000001 / tick_hz
        assert timing.lateness_s == now_s - timing.deadline_s
        missed += timing.missed
        indices.append(timing.index)
        now_s += chance.choice((0.0, 0.5, 1.0, 2.5)) / tick_hz
        pacer.end(now_s)
    pacer.finish(now_s + 2 * count / tick_hz)

    summary = pacer.summary()
    assert indices == sorted(set(indices))
    assert summary["run"] == len(indices)
    assert summary["not_run"] == not_run
    assert summary["missed"] >= missed
    assert summary["due"] == summary["run"] + summary["missed"] + not_run == count


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 10, 24, 93, 1000])
def test_staggered_phases_divide_the_period_evenly(count):
    phases = sorted(staggered(count, 50.0))

    assert phases == pytest.approx([k / count / 50.0 for k in range(count)])
    assert all(0 <= phase * 50.0 < 1 for phase in phases)


@pytest.mark.parametrize(("count", "together"), [(24, 4), (93, 5), (1000, 50)])
def test_neighbours_on_one_machine_are_spread_over_the_period(count, together):
    phases_s = staggered(count, 1.0)
    for first in range(0, count - together, together):
        phases = sorted(phases_s[first : first + together])
        gaps = [b - a for a, b in zip(phases, [*phases[1:], phases[0] + 1], strict=True)]
        assert min(gaps) > 0.3 / together


def test_aligned_agents_have_no_phase():
    assert staggered(5, 10.0, phase="aligned") == [0.0] * 5


def test_small_lateness_is_told_exactly():
    histogram = LatenessHistogram()
    for value_us in range(1, 31):
        histogram.add(value_us)

    assert histogram.percentile_us(50) == 15
    assert histogram.percentile_us(100) == 30
    assert histogram.count == 30


def test_percentile_reads_at_most_a_sixteenth_too_high():
    chance = random.Random(7)
    values = [int(chance.lognormvariate(6, 2)) for _ in range(5000)]
    histogram = LatenessHistogram()
    for value_us in values:
        histogram.add(value_us)
    values.sort()

    for percent in (1, 25, 50, 90, 99, 99.9, 100):
        exact = values[math.ceil(len(values) * percent / 100) - 1]
        assert exact <= histogram.percentile_us(percent) <= exact * 17 / 16
    assert histogram.max_us == values[-1]


def test_histogram_holds_any_value_in_bounded_memory():
    histogram = LatenessHistogram()

    for value_us in (-5, 10**15, 10**15 - 1, 2**36 - 1):
        histogram.add(value_us)

    assert histogram.percentile_us(1) == 0
    assert histogram.percentile_us(100) == histogram.max_us == LatenessHistogram.VALUE_US_MAX


def test_empty_histogram_reads_zero():
    assert LatenessHistogram().percentile_us(99) == 0


def test_real_time_factor_spans_the_first_to_the_last_tick():
    factor = RealTimeFactor()
    assert factor.value() is None

    factor.add(2.0, 100.0)
    assert factor.value() is None

    factor.add(5.0, 101.0)
    factor.add(12.0, 105.0)
    assert factor.value() == 2.0


def test_no_tick_is_run_behind_an_end_that_is_ordered_in_the_last_ones_period():
    pacer = make_pacer(tick_hz=1.0, duration_s=60.0)
    for index in range(5):
        run_tick(pacer, index + 0.001, index + 0.002)

    pacer.end_by(5.0)  # ordered at 4.1 s, say

    assert pacer.is_over
    assert pacer.next_deadline_s() is None
    assert pacer.begin(5.0) is None
    pacer.finish(7.0)
    assert pacer.summary()["due"] == pacer.summary()["run"] == 5


def test_a_later_end_than_the_runs_own_changes_nothing():
    pacer = make_pacer(tick_hz=1.0, duration_s=2.0)

    pacer.end_by(5.0)

    assert pacer.tick_count == 2


@pytest.mark.parametrize("tick_hz", [0.1, 0.25, 1.0, 3.0, 7.0, 333.0])
@pytest.mark.parametrize("duration_s", [0.7, 8.5, 10.0, 61.0])
def test_no_tick_is_due_behind_the_last_period_whatever_its_phase(tick_hz, duration_s):
    over_s = last_period_s(duration_s, tick_hz)
    for phase_s in staggered(5, tick_hz):
        pacer = make_pacer(tick_hz, phase_s, duration_s)
        assert pacer.deadline_of(pacer.tick_count - 1) < over_s
    assert duration_s <= over_s < duration_s + 1.0 / tick_hz + 1e-9


def test_a_run_of_whole_periods_is_over_with_the_last():
    assert [last_period_s(duration_s, 10.0) for duration_s in (0.3, 0.7, 60.0)] == [0.3, 0.7, 60.0]


@pytest.mark.parametrize(
    ("t_s", "duration_s", "tick_hz", "phase_s", "expected"),
    [
        (5.0, 6.0, 1.0, 0.0, True),
        (5.5, 6.0, 1.0, 0.0, False),
        (5.5, 6.0, 1.0, 0.5, True),
        (5.6, 6.0, 1.0, 0.5, False),
        (0.6, 0.7, 10.0, 0.0, True),
        (0.3 + 0.3 + 0.0000000001, 0.7, 10.0, 0.0, True),
        (0.0, 0.0, 1.0, 0.0, False),
    ],
)
def test_a_tick_is_left_until_the_last_one_is_due(t_s, duration_s, tick_hz, phase_s, expected):
    assert has_tick_from(t_s, duration_s, tick_hz, phase_s) is expected
