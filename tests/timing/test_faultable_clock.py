"""A local clock that is put wrong on purpose: the estimate of the host's clock is wrong with it, and finds it again."""

import pytest

from madns_runtime.faults.clock_faults import FaultableClock

ROUND_TRIP_S = 0.001
PING_S = 0.25
HOST_AHEAD_S = 1000.0


def fly(clock, from_s, until_s):
    """Exchange every PING_S, and return how far the host's time was taken wrong after each, by time."""
    errors = {}
    for number in range(round(from_s / PING_S), round(until_s / PING_S)):
        t_s = number * PING_S
        middle_s = HOST_AHEAD_S + t_s + ROUND_TRIP_S / 2.0
        assert clock.add_exchange(t_s, middle_s, middle_s, t_s + ROUND_TRIP_S)
        at_s = t_s + PING_S / 2.0
        errors[at_s] = clock.to_host_s(at_s) - (HOST_AHEAD_S + at_s)
    return errors


@pytest.fixture
def clock():
    clock = FaultableClock()
    fly(clock, 0.0, 20.0)
    return clock


@pytest.mark.parametrize("by_s", [0.2, -0.2])
def test_a_step_puts_host_time_off_by_as_much_until_exchanges_contradict_it(clock, by_s):
    assert clock.step(1, by_s, 20.0)

    assert clock.to_host_s(20.0) - HOST_AHEAD_S - 20.0 == pytest.approx(by_s, abs=1e-4)
    errors = fly(clock, 20.0, 30.0)
    assert clock.steps == 1
    assert errors[20.125] == pytest.approx(by_s, abs=1e-3)
    assert abs(errors[29.875]) < 1e-3
    assert clock.offset_s(29.9) == pytest.approx(HOST_AHEAD_S - by_s, abs=1e-3)


def test_host_time_does_not_run_backwards_after_a_step_back_while_another_is_slewed_out(clock):
    clock.step(1, 1.0, 20.0)
    fly(clock, 20.0, 21.0)
    clock.to_host_s(21.0)
    clock.step(2, -0.1, 21.0)
    before_s = clock.to_host_s(21.0)

    middle_s = HOST_AHEAD_S + 20.9
    assert clock.add_exchange(20.8, middle_s, middle_s, 21.0)  # too long under way to contradict
    assert clock.steps == 1
    assert clock.to_host_s(21.0) >= before_s


def test_host_and_local_time_are_each_others_inverse_while_a_clock_is_wrong(clock):
    clock.step(1, 0.3, 20.0)
    clock.drift(2, 400.0, 21.0)

    for t_s in (21.0, 25.0, 80.0):
        assert clock.to_local_s(clock.to_host_s(t_s)) == pytest.approx(t_s, abs=1e-9)


def test_a_drift_is_followed_and_its_end_leaves_what_was_gained(clock):
    clock.drift(1, 200.0, 20.0)
    errors = fly(clock, 20.0, 140.0)

    assert clock.drift_ppm == pytest.approx(-200.0, abs=20.0)
    assert abs(errors[139.875]) < 1e-3
    assert clock.end_drift(1, 140.0)
    assert clock.wrong_s(200.0) == pytest.approx(200.0 + 120.0 * 200e-6)


def test_one_action_puts_the_clock_of_agents_that_share_a_process_wrong_once(clock):
    assert [clock.step(7, 0.1, 20.0), clock.step(7, 0.1, 20.0)] == [True, False]
    assert [clock.drift(8, 100.0, 20.0), clock.drift(8, 100.0, 20.0)] == [True, False]
    assert [clock.end_drift(8, 20.0), clock.end_drift(8, 20.0)] == [False, True]

    assert clock.wrong_s(30.0) == pytest.approx(30.1)


def test_a_drift_goes_on_while_it_is_a_fault_of_another_agent_of_the_process(clock):
    clock.drift(8, 100.0, 20.0)
    clock.drift(8, 100.0, 20.0)

    assert not clock.end_drift(8, 30.0)  # one of them was killed
    assert clock.wrong_s(40.0) == pytest.approx(40.0 + 20.0 * 100e-6)
    assert clock.end_drift(8, 40.0)
    assert clock.wrong_s(90.0) == pytest.approx(90.0 + 20.0 * 100e-6)


def test_a_clock_that_nobody_put_wrong_shows_the_time(clock):
    assert clock.wrong_s(1234.5678) == 1234.5678
    assert clock.steps == 0


@pytest.mark.parametrize(
    "change",
    [
        lambda clock: clock.step(1, 0.2, 20.0),
        lambda clock: clock.drift(1, 50.0, 20.0),
        lambda clock: clock.add_exchange(20.0, 1020.0004, 1020.0004, 20.0005),
        lambda clock: clock.settle(20.0, is_unused=True),
    ],
    ids=["step", "drift", "exchange", "settling"],
)
def test_a_time_of_the_host_is_the_same_local_time_until_a_change_is_counted(clock, change):
    known = clock.changes
    before_s = clock.to_local_s(HOST_AHEAD_S + 30.0)
    clock.to_host_s(20.0)
    assert clock.changes == known

    change(clock)

    assert clock.changes == known + 1
    assert clock.to_local_s(HOST_AHEAD_S + 30.0) != before_s


def test_the_end_of_a_drift_is_a_change(clock):
    clock.drift(1, 50.0, 20.0)
    known = clock.changes

    assert clock.end_drift(1, 25.0)
    assert clock.changes == known + 1
