"""Simulated time as an agent's devices are told it."""

from types import SimpleNamespace

import pytest

from madns_runtime.faults.clock_faults import FaultableClock
from madns_runtime.realtime import device_time
from madns_runtime.realtime.device_time import ERROR_S_MAX, DeviceTime

PING_S = 0.25
TICK_S = 0.01
HOST_AHEAD_S = 1000.0


class Bench:
    """An agent with a device, on a machine whose clock runs as the host's."""

    def __init__(self, monkeypatch):
        self.now_s, self.told = 100.0, []
        monkeypatch.setattr(device_time, "monotonic", lambda: self.now_s)
        self.clock = FaultableClock()
        self.fly(20.0)
        session = SimpleNamespace(clock=self.clock)
        port = SimpleNamespace(session=session, at=self.t_s, local_s=None)
        hardware = SimpleNamespace(
            tell_time=lambda *told: self.told.append(told), use_clock=lambda local_s: None
        )
        self.end_s = 600.0
        self.time = DeviceTime(hardware, port, lambda: self.end_s)
        self.time.tell()

    def t_s(self, local_s):
        return self.clock.to_host_s(local_s) - HOST_AHEAD_S

    def fly(self, for_s):
        """Exchange times with the host every PING_S."""
        for _ in range(round(for_s / PING_S)):
            self.now_s += PING_S
            host_s = self.now_s - 0.0005 + HOST_AHEAD_S
            assert self.clock.add_exchange(self.now_s - 0.001, host_s, host_s, self.now_s)

    def tick(self, for_s):
        """Follow in every tick, and return by how much devices were wrong right before."""
        errors_s = []
        for _ in range(round(for_s / TICK_S)):
            self.now_s += TICK_S
            local_s, t_s, rate, _ = self.told[-1]
            told_s = t_s + (self.now_s - local_s) * rate
            errors_s.append(abs(told_s - self.t_s(self.now_s)))
            self.time.follow()
        return errors_s


@pytest.fixture
def bench(monkeypatch):
    return Bench(monkeypatch)


def test_what_holds_is_told_once(bench):
    assert max(bench.tick(10.0)) < ERROR_S_MAX
    assert len(bench.told) == 1


@pytest.mark.parametrize("ppm", [500.0, -500.0])
def test_devices_of_a_clock_that_drifts_on_purpose_are_told_the_rate_that_their_agent_has(
    bench, ppm
):
    bench.clock.drift(1, ppm, bench.now_s)
    bench.fly(100.0)
    bench.time.tell()  # as now and then
    told = len(bench.told)

    assert max(bench.tick(10.0)) < ERROR_S_MAX
    assert len(bench.told) == told


def test_a_clock_that_steps_is_told_in_the_next_tick(bench):
    bench.clock.step(1, 0.2, bench.now_s)

    assert bench.tick(2 * TICK_S) == pytest.approx([0.2, 0.0], abs=1e-6)
    assert len(bench.told) == 2


def test_a_stop_that_makes_the_end_sooner_is_told_in_the_next_tick(bench):
    bench.end_s = 30.0

    bench.tick(2 * TICK_S)

    assert [told[-1] for told in bench.told] == [600.0, 30.0]
