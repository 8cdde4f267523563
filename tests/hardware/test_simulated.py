"""Devices that follow simulated time, in real time: what they had to tell while they were closed."""

from __future__ import annotations

import math
from time import monotonic

import pytest

from madns_runtime.errors import PluginError
from madns_runtime.hardware import page, simulated
from madns_runtime.hardware.contract import Channel, Sample, SimulatedDevice
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.records import SimulatedTime

LEVEL = Channel(name="level")
COUNT_MAX = 20


class Tape(SimulatedDevice):
    """Samples at given times; one that stands still tells of its first for ever."""

    def __init__(self, times_s, *, stands_still=False):
        self.left_s, self.stands_still = list(times_s), stands_still

    def sample_at(self, t_s):
        at_s = self.left_s[0] if self.stands_still else self.left_s.pop(0)
        return Sample(values={"level": at_s}, taken_s=at_s)

    def next_s(self):
        return self.left_s[0] if self.left_s else math.inf


def passed_over(tape):
    """Open a tape anew 100 s after simulated time began."""
    time = SimulatedTime()
    time.set(monotonic() - 100.0, 0.0, 1.0)
    return simulated.pass_over(tape, time, DevicePage([LEVEL]).header)


def given_by_now(device, time):
    """Return what a device gives by now, and when its page says that it was opened."""
    header = DevicePage([LEVEL]).header
    given = list(simulated.samples_by_now(device, time, header, COUNT_MAX))
    return given, header[page.OPENED_S]


@pytest.fixture(autouse=True)
def few_at_once(monkeypatch):
    monkeypatch.setattr(simulated, "AT_ONCE_MAX", COUNT_MAX)


def test_what_a_device_had_to_tell_while_it_was_closed_is_passed_over_however_much_it_is():
    many = [0.1 * number for number in range(10 * COUNT_MAX)]
    several_at_once = [*many, *[60.0] * COUNT_MAX, 1e6]
    tape = Tape(several_at_once)

    assert passed_over(tape) == len(several_at_once) - 1
    assert tape.left_s == [1e6]


def test_a_driver_that_lets_time_stand_still_is_told_so():
    with pytest.raises(PluginError, match=r"more than 20 samples at 5 s: next_s\(\) should tell"):
        passed_over(Tape([5.0], stands_still=True))


def test_a_driver_that_lets_time_go_on_by_nanoseconds_is_told_so_too():
    with pytest.raises(PluginError, match=r"more than 20 samples at 5 s: next_s\(\) should tell"):
        passed_over(Tape([5.0 + 1e-9 * number for number in range(COUNT_MAX + 1)]))


@pytest.mark.parametrize("told", [math.nan, "soon", [1.0]])
def test_a_next_time_that_is_none_is_refused_in_real_time(told):
    tape = Tape([0.0, 1.0])
    tape.next_s = lambda: told
    with pytest.raises(PluginError, match="next_s: expected a simulated time, s, infinity for nev"):
        given_by_now(tape, SimulatedTime())


@pytest.mark.parametrize(("told", "time_s"), [(None, None), (2, 2.0), (math.inf, math.inf)])
def test_a_next_time_is_a_number_or_none(told, time_s):
    tape = Tape([])
    tape.next_s = lambda: told

    assert simulated.next_of(tape) == time_s


def test_of_samples_that_are_finite_any_number_may_be_of_one_time():
    tape = Tape([5.0] * (3 * COUNT_MAX))
    tape.is_finite = True

    assert passed_over(tape) == 3 * COUNT_MAX


def test_a_sample_with_a_time_of_its_own_is_given_then_and_not_while_time_is_still_to_begin():
    tape, began_s = Tape([0.0, 0.5, 60.0]), monotonic()
    unknown, early, running = SimulatedTime(), SimulatedTime(), SimulatedTime()
    early.set(began_s + 300.0, 0.0, 1.0)
    running.set(began_s - 1.0, 0.0, 1.0)

    for time in (unknown, early):
        given, opened_s = given_by_now(tape, time)
        assert given == []
        assert opened_s >= began_s, "nobody has waited for it so far"
    given, opened_s = given_by_now(tape, running)
    assert [each.values["level"] for each in given] == [0.0, 0.5]
    assert [each.taken_s - began_s for each in given] == pytest.approx([-1.0, -0.5])
    assert opened_s == 0.0


def test_a_device_that_is_asked_at_its_rate_gives_what_it_has_at_0_before_time_runs():
    device = SimulatedDevice(None)
    device.sample_at = lambda t_s: Sample(values={"level": t_s}, taken_s=t_s)

    given, _ = given_by_now(device, SimulatedTime())

    assert [each.values["level"] for each in given] == [0.0]


@pytest.mark.parametrize(
    ("next_s", "waited_for"), [(None, False), (200.0, True), (math.inf, True), (50.0, False)]
)
def test_a_device_that_has_nothing_new_before_a_time_may_be_silent_until_then(next_s, waited_for):
    time = SimulatedTime()
    assert simulated.is_waited_for(time, next_s) == (next_s is not None), "time has not begun"
    time.set(monotonic(), 100.0, 1.0)

    assert simulated.is_waited_for(time, next_s) == waited_for
    if next_s is not None:
        assert simulated.pause_s(time, next_s) == (simulated.ASKED_AGAIN_S if waited_for else 0.0)
