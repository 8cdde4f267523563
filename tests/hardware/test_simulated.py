"""Devices that follow simulated time, in real time: what they had to tell while they were closed."""

from __future__ import annotations

import math
from time import monotonic

import pytest

from madns_runtime.errors import PluginError
from madns_runtime.hardware import simulated
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
        list(simulated.samples_by_now(tape, SimulatedTime(), COUNT_MAX))


@pytest.mark.parametrize(("told", "time_s"), [(None, None), (2, 2.0), (math.inf, math.inf)])
def test_a_next_time_is_a_number_or_none(told, time_s):
    tape = Tape([])
    tape.next_s = lambda: told

    assert simulated.next_of(tape) == time_s


def test_of_samples_that_are_finite_any_number_may_be_of_one_time():
    tape = Tape([5.0] * (3 * COUNT_MAX))
    tape.is_finite = True

    assert passed_over(tape) == 3 * COUNT_MAX
