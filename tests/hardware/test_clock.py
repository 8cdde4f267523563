"""A device's own clock, estimated from its samples."""

from __future__ import annotations

import random

import pytest

from madns_runtime.hardware.clock import POINTS_MAX, DeviceClock


def run(
    clock: DeviceClock, *, drift: float, seconds: float, hz: float = 100.0, start_s: float = 0.0
) -> None:
    """Sample a clock that runs (1 + drift) times as fast, with delays like a busy machine's."""
    numbers = random.Random(5)
    for number in range(int(seconds * hz)):
        true_s = start_s + number / hz
        delay_s = (
            0.0005 + numbers.expovariate(1.0 / 0.002) + (0.05 if numbers.random() < 0.02 else 0.0)
        )
        clock.add(true_s * (1.0 + drift) + 17.0, 5000.0 + true_s + delay_s)


@pytest.mark.parametrize("drift", [0.0417, -0.0417, 50e-6, 0.0])
def test_drift_is_found_within_200_ppm_after_90_s(drift):
    clock = DeviceClock()

    run(clock, drift=drift, seconds=90.0)

    assert clock.estimate().drift_ppm == pytest.approx(drift * 1e6, abs=200.0)
    assert clock.steps == 0


def test_offset_is_that_of_the_quickest_samples():
    clock = DeviceClock()

    run(clock, drift=0.0, seconds=30.0)

    assert clock.estimate().offset_s == pytest.approx(5000.0 - 17.0 + 0.0005, abs=0.0005)


def test_nothing_is_said_before_there_is_something_to_say():
    clock = DeviceClock()
    assert clock.estimate() is None
    run(clock, drift=0.0, seconds=1.0)
    assert clock.estimate() is None


def test_a_step_back_begins_anew():
    clock = DeviceClock()
    run(clock, drift=0.0, seconds=20.0)
    run(clock, drift=0.01, seconds=20.0, start_s=1.0)

    assert clock.steps >= 1
    assert clock.estimate().drift_ppm == pytest.approx(10_000, abs=500)


def test_what_is_kept_is_bounded_and_what_is_no_number_left_out():
    clock = DeviceClock()
    run(clock, drift=0.0, seconds=300.0)
    before = clock.estimate()
    clock.add(float("nan"), 1.0)
    clock.add(1.0, float("inf"))

    assert len(clock._points) <= POINTS_MAX
    assert clock.estimate() == before


def test_of_a_buffer_that_is_handed_over_at_once_no_clock_is_estimated():
    clock = DeviceClock()
    for number in range(31):
        clock.add(0.1 * number, 5000.0)
    estimates = [clock.estimate()]
    for number in range(31, 2000):
        clock.add(0.1 * number, 5000.0 + 0.1 * (number - 30))
    estimates.append(clock.estimate())

    assert estimates[0] is None
    assert estimates[1].drift_ppm == pytest.approx(0.0, abs=1.0)
