import itertools
import math
import random

import pytest

from madns_runtime.errors import PeerError
from madns_runtime.timing import clocksync
from madns_runtime.timing.clocksync import ClockEstimate

PING_S = 0.25


class Wire:
    """Two clocks and a network between them, under a seed; all that happens is told by local time."""

    def __init__(self, seed=0, *, offset_s=1234.5, drift=50e-6, there_s=1e-4, back_s=1e-4):
        self.random = random.Random(seed)
        self.offset_at_zero_s = offset_s
        self.drift = drift
        self.base_s = (there_s, back_s)
        self.jitter_s = 5e-5
        self.tail_share = 0.05
        self.tail_s = 0.02
        self.steps = []

    def offset_s(self, local_s):
        stepped_s = sum(size for when, size in self.steps if local_s >= when)
        return self.offset_at_zero_s + self.drift * local_s + stepped_s

    def delay_s(self, way):
        delay_s = self.base_s[way] + self.random.expovariate(1 / self.jitter_s)
        if self.random.random() < self.tail_share:
            delay_s += self.random.expovariate(1 / self.tail_s)
        return delay_s

    def exchange(self, sent_s):
        at_host_s = sent_s + self.delay_s(0)
        answered_s = at_host_s + 20e-6
        return (
            sent_s,
            at_host_s + self.offset_s(at_host_s),
            answered_s + self.offset_s(answered_s),
            answered_s + self.delay_s(1),
        )


def feed(estimate, wire, start_s, end_s, *, each=lambda now_s: None, interval_s=PING_S):
    """Exchange from start to end; call *each* at times that rise, some of them between exchanges."""
    now_s = start_s
    while now_s < end_s:
        exchange = wire.exchange(now_s)
        estimate.add_exchange(*exchange)
        now_s = max(now_s + interval_s, exchange[3])
        for share in (0.0, 0.3, 0.9):
            each(exchange[3] + share * (now_s - exchange[3]))
    return now_s


class Watch:
    """Compares an estimate with the truth, and sees that host time rises."""

    def __init__(self, estimate, wire):
        self.estimate = estimate
        self.wire = wire
        self.inside = 0
        self.total = 0
        self.error_s = math.nan
        self.last = (-math.inf, -math.inf)

    def __call__(self, now_s):
        host_s = self.estimate.to_host_s(now_s)
        if self.estimate.is_valid and now_s > self.last[0]:
            assert host_s > self.last[1]
            self.last = (now_s, host_s)
        assert self.estimate.to_local_s(host_s) == pytest.approx(now_s, abs=1e-9)
        self.error_s = abs(self.estimate.offset_s(now_s) - self.wire.offset_s(now_s))
        self.total += 1
        self.inside += self.error_s <= self.estimate.uncertainty_s(now_s)


@pytest.mark.slow
@pytest.mark.parametrize("drift", [-600e-6, -50e-6, 0.0, 150e-6])
@pytest.mark.parametrize(
    ("there_s", "back_s"), [(1e-4, 1e-4), (5e-5, 4e-4), (1e-3, 5e-5), (2e-5, 2e-5)]
)
@pytest.mark.parametrize("jitter_s", [1e-5, 5e-4])
def test_true_offset_lies_within_the_uncertainty(drift, there_s, back_s, jitter_s):
    inside = total = 0
    for seed in range(3):
        wire = Wire(seed, drift=drift, there_s=there_s, back_s=back_s)
        wire.jitter_s = jitter_s
        estimate = ClockEstimate()
        watch = Watch(estimate, wire)
        now_s = feed(estimate, wire, 10.0, 10.4, each=watch, interval_s=0.02)
        feed(estimate, wire, now_s, 100.0, each=watch)
        inside += watch.inside
        total += watch.total
        assert estimate.steps == 0

    assert inside / total >= 0.99


def test_uncertainty_is_of_use_and_not_merely_safe():
    wire = Wire(1)
    estimate = ClockEstimate()

    now_s = feed(estimate, wire, 0.0, 70.0)

    assert abs(estimate.offset_s(now_s) - wire.offset_s(now_s)) < 20e-6
    assert estimate.uncertainty_s(now_s) < 200e-6
    assert estimate.round_trip_s_min < 250e-6


@pytest.mark.parametrize("drift_ppm", [-100.0, 0.0, 50.0, 600.0])
def test_drift_is_found(drift_ppm):
    wire = Wire(2, drift=drift_ppm * 1e-6)
    estimate = ClockEstimate()

    feed(estimate, wire, 0.0, 90.0)

    assert estimate.drift_ppm == pytest.approx(drift_ppm, abs=1.0)


def test_slewing_of_a_clock_in_mid_run_is_followed():
    """As by a time service that takes 15 ms out of a board's clock at its greatest rate."""
    wire = Wire(3)
    straight_s = wire.offset_s
    wire.offset_s = lambda local_s: (
        straight_s(local_s) + 500e-6 * min(max(local_s - 60.0, 0.0), 30.0)
    )
    estimate = ClockEstimate()
    errors_s = []

    now_s = feed(estimate, wire, 0.0, 60.0)
    feed(
        estimate,
        wire,
        now_s,
        150.0,
        each=lambda at_s: errors_s.append(abs(estimate.offset_s(at_s) - wire.offset_s(at_s))),
    )

    assert max(errors_s) < 1e-3
    assert errors_s[-1] < 20e-6


def test_same_clock_reads_no_offset():
    wire = Wire(3, offset_s=0.0, drift=0.0, there_s=2e-5, back_s=3e-5)
    estimate = ClockEstimate()

    now_s = feed(estimate, wire, 50_000.0, 50_060.0)

    assert abs(estimate.offset_s(now_s)) <= estimate.uncertainty_s(now_s)
    assert abs(estimate.offset_s(now_s)) < 20e-6
    assert abs(estimate.drift_ppm) < 2.0


def test_a_queue_in_one_direction_does_not_pull_the_estimate_along():
    wire = Wire(4)
    estimate = ClockEstimate()
    now_s = feed(estimate, wire, 0.0, 40.0)
    wire.base_s = (1e-4, 5e-3)

    now_s = feed(estimate, wire, now_s, 45.0)

    assert abs(estimate.offset_s(now_s) - wire.offset_s(now_s)) < 50e-6


def test_nothing_is_known_before_the_first_exchange():
    estimate = ClockEstimate()

    assert not estimate.is_valid
    assert estimate.uncertainty_s(1.0) == estimate.round_trip_s_min == math.inf
    assert estimate.drift_ppm == 0.0
    for ask in (estimate.offset_s, estimate.to_host_s, estimate.to_local_s):
        with pytest.raises(PeerError, match="no exchange"):
            ask(1.0)


def test_first_exchange_bounds_the_offset_by_half_its_round_trip():
    estimate = ClockEstimate()

    estimate.add_exchange(10.0, 110.003, 110.004, 10.005)

    assert not estimate.is_valid
    assert estimate.offset_s(10.0) == pytest.approx(100.001, abs=1e-9)
    assert 0.002 <= estimate.uncertainty_s(10.0025) < 0.0021
    assert estimate.round_trip_s_min == pytest.approx(0.004)


def test_estimate_becomes_valid_after_a_few_exchanges():
    wire = Wire(5)
    estimate = ClockEstimate()

    valid = []
    for k in range(4):
        estimate.add_exchange(*wire.exchange(k * 0.02))
        valid.append(estimate.is_valid)

    assert valid == [False, False, True, True]


@pytest.mark.parametrize(
    "exchange",
    [
        (10.0, 5.0, 5.1, 9.9),  # came before it left
        (10.0, 5.1, 5.0, 10.3),  # the host answered before it heard
        (10.0, 5.0, 5.5, 10.1),  # the host took longer than both ways together
        (math.nan, 5.0, 5.0, 10.1),
        (10.0, math.inf, math.inf, 10.1),
        (10.0, 5.0, 5.0, math.inf),
    ],
)
def test_exchange_that_cannot_be_is_rejected_and_counted(exchange):
    wire = Wire(6)
    estimate = ClockEstimate()
    feed(estimate, wire, 0.0, 5.0)
    before = (estimate.offset_s(10.0), estimate.exchanges)

    assert estimate.add_exchange(*exchange) is False

    assert (estimate.offset_s(10.0), estimate.exchanges) == before
    assert estimate.rejected == 1


def test_uncertainty_grows_with_age():
    wire = Wire(7)
    estimate = ClockEstimate()
    now_s = feed(estimate, wire, 0.0, 60.0)

    ages = [estimate.uncertainty_s(now_s + age_s) for age_s in (0, 10, 100, 1000)]

    assert all(a < b for a, b in itertools.pairwise(ages))
    assert ages[-1] < 1000 * clocksync.DRIFT_MAX + 1e-3


def test_memory_is_bounded_and_the_window_slides():
    wire = Wire(8)
    estimate = ClockEstimate()

    now_s = feed(estimate, wire, 0.0, 300.0)

    kept = estimate._samples
    assert len(kept) <= clocksync.SLOTS_MAX
    assert kept[0].local_s >= now_s - 66.0
    assert kept[0].local_s < now_s - 50.0


def test_frozen_agent_takes_up_where_it_left():
    wire = Wire(9)
    estimate = ClockEstimate()
    watch = Watch(estimate, wire)
    now_s = feed(estimate, wire, 0.0, 40.0, each=watch)

    # The answer waited in the socket for 20 s, until the agent was thawed.
    sent_s, received_s, answered_s, _ = wire.exchange(now_s)
    estimate.add_exchange(sent_s, received_s, answered_s, now_s + 20.0)
    now_s = feed(estimate, wire, now_s + 20.0, 90.0, each=watch)

    assert watch.inside == watch.total
    assert estimate.steps == 0
    assert watch.error_s < 50e-6


def test_long_silence_empties_the_window_and_not_the_estimate():
    wire = Wire(10)
    estimate = ClockEstimate()
    watch = Watch(estimate, wire)
    now_s = feed(estimate, wire, 0.0, 70.0, each=watch)
    watch(now_s + 599.0)

    feed(estimate, wire, now_s + 600.0, now_s + 600.4, each=watch)

    assert len(estimate._samples) <= 3
    assert watch.inside == watch.total
    assert estimate.steps == 0


@pytest.mark.parametrize("step_s", [0.01, 0.5, 3600.0])
def test_step_forward_is_found_counted_and_followed_at_once(step_s):
    wire = Wire(11)
    wire.tail_share = 0.0
    wire.steps.append((30.0, step_s))
    estimate = ClockEstimate()
    watch = Watch(estimate, wire)

    now_s = feed(estimate, wire, 0.0, 31.0, each=watch)

    assert estimate.steps == 1
    assert estimate.is_valid
    assert abs(estimate.offset_s(now_s) - wire.offset_s(now_s)) < estimate.uncertainty_s(now_s)


@pytest.mark.parametrize("step_s", [-0.01, -0.5, -2.0])
def test_step_back_is_slewed_while_time_goes_on(step_s):
    wire = Wire(12)
    wire.tail_share = 0.0
    wire.steps.append((30.0, step_s))
    estimate = ClockEstimate()
    watch = Watch(estimate, wire)  # asserts that host time rises all the while
    feed(estimate, wire, 0.0, 32.0, each=watch)
    inside_before, total_before = watch.inside, watch.total

    now_s = feed(estimate, wire, 32.0, 45.0, each=watch)

    assert estimate.steps == 1
    assert watch.inside - inside_before == watch.total - total_before
    assert abs(estimate.offset_s(now_s) - wire.offset_s(now_s)) < 100e-6


def test_settled_clock_serves_what_it_knows_at_once():
    wire = Wire(14)
    estimate = ClockEstimate()
    for _ in range(5):  # the answers waited 4 s in the socket
        sent_s, received_s, answered_s, _ = wire.exchange(0.0)
        estimate.add_exchange(sent_s, received_s, answered_s, 4.0)
    now_s = feed(estimate, wire, 4.0, 4.2, interval_s=0.02)
    assert abs(estimate.offset_s(now_s) - wire.offset_s(now_s)) > 0.5  # still slewing
    assert estimate.error_s(now_s) < 0.02 < estimate.uncertainty_s(now_s)

    estimate.settle(now_s)

    assert abs(estimate.offset_s(now_s) - wire.offset_s(now_s)) < estimate.error_s(now_s)
    assert estimate.uncertainty_s(now_s) == estimate.error_s(now_s)


def test_nothing_known_settles_nothing():
    estimate = ClockEstimate()
    estimate.settle(1.0)
    assert estimate.error_s(1.0) == estimate.uncertainty_s(1.0) == math.inf


def test_single_exchange_that_lies_is_not_a_step():
    wire = Wire(13)
    estimate = ClockEstimate()
    now_s = feed(estimate, wire, 0.0, 30.0)
    sent_s, received_s, answered_s, got_s = wire.exchange(now_s)

    estimate.add_exchange(sent_s, received_s + 5.0, answered_s + 5.0, got_s)
    now_s = feed(estimate, wire, got_s + PING_S, 32.0)

    assert estimate.steps == 0
    assert abs(estimate.offset_s(now_s) - wire.offset_s(now_s)) < 50e-6


def test_correction_is_spread_so_that_time_runs_slower_rather_than_back():
    estimate = ClockEstimate()
    for k in range(3):
        # All that came so far waited 20 ms on its way back: the offset reads 10 ms too small.
        estimate.add_exchange(k * 0.02, 100 + k * 0.02, 100 + k * 0.02, k * 0.02 + 0.02)
    before_s = estimate.to_host_s(0.1)

    estimate.add_exchange(0.1, 100.1, 100.1, 0.1)

    assert estimate.to_host_s(0.1) == pytest.approx(before_s, abs=1e-9)
    rate = (estimate.to_host_s(0.2) - estimate.to_host_s(0.1)) / 0.1
    assert 1.0 < rate < 1.02
    assert estimate.uncertainty_s(0.1) > 0.009
    assert estimate.to_host_s(1.5) == pytest.approx(101.5, abs=1e-4)
    assert estimate.uncertainty_s(1.5) < estimate.uncertainty_s(0.1)


def test_what_was_asked_between_answer_and_estimate_still_holds():
    wire = Wire(14)
    estimate = ClockEstimate()
    feed(estimate, wire, 0.0, 1.0)
    exchange = wire.exchange(2.0)
    asked_s = exchange[3] + 0.01
    before_s = estimate.to_host_s(asked_s)

    estimate.add_exchange(*exchange)

    assert estimate.to_host_s(asked_s) == pytest.approx(before_s, abs=1e-9)


def test_host_and_local_time_are_inverse_on_every_piece():
    estimate = ClockEstimate()
    for k in range(4):
        wait_s = 0.02 if k < 3 else 0.0
        estimate.add_exchange(k * 0.1, 50 + k * 0.1, 50 + k * 0.1, k * 0.1 + wait_s)

    for k in range(-50, 300):
        local_s = k / 100
        assert estimate.to_local_s(estimate.to_host_s(local_s)) == pytest.approx(local_s, abs=1e-9)
