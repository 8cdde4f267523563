"""The clock that stands while processes wait for a processor: by simulated readings, and of real processes."""

import os
import signal
import subprocess
import sys
import time

import pytest

from madns_runtime.timing.granted_clock import (
    LOOK_S_MAX,
    GrantedClock,
    ThreadReading,
    is_stopped,
    read_trees,
    waited_s,
)

MAIN = (10, 10)


class Machine:
    """One thread of a pretended computer."""

    def __init__(self):
        self.now_s = 100.0
        self.cpu_s = 0.0
        self.delay_s = 0.0
        self.is_runnable = False
        self.has_ended = False

    def clock(self):
        return self.now_s

    def read(self, roots):
        assert list(roots) == [10]
        reading = ThreadReading(self.is_runnable, self.cpu_s, self.delay_s)
        return {} if self.has_ended else {MAIN: reading}

    def granted(self):
        return GrantedClock(lambda: (10,), read=self.read, clock=self.clock)


def advance(machine, clock, seconds, *, cpu=0.0, delay=0.0, step_s=0.5):
    """Let time pass in which a share of it is computed, and a share waited, and look now and then."""
    for _ in range(round(seconds / step_s)):
        machine.now_s += step_s
        machine.cpu_s += cpu * step_s
        machine.delay_s += delay * step_s
        clock.now_s()
    return clock.now_s()


def test_a_sleep_counts_in_full():
    machine = Machine()

    assert advance(machine, machine.granted(), 30.0) == pytest.approx(30.0)


def test_a_loop_that_has_a_processor_counts_in_full():
    machine = Machine()
    machine.is_runnable = True

    assert advance(machine, machine.granted(), 30.0, cpu=1.0) == pytest.approx(30.0)


def test_a_starved_loop_counts_what_it_computes():
    machine = Machine()
    machine.is_runnable = True

    assert advance(machine, machine.granted(), 100.0, cpu=0.02, delay=0.98) == pytest.approx(2.0)


def test_a_wait_that_is_not_over_counts_not_at_all():
    # The kernel enters a wait when it is over: until then only the state tells of it.
    machine = Machine()
    machine.is_runnable = True

    assert advance(machine, machine.granted(), 100.0) == 0.0


def test_waits_of_a_thread_that_sleeps_when_it_is_looked_at_do_not_count():
    machine = Machine()

    assert advance(machine, machine.granted(), 100.0, cpu=0.1, delay=0.6) == pytest.approx(40.0)


def test_who_was_itself_starved_counts_one_look():
    machine = Machine()
    clock = machine.granted()
    machine.now_s += 60.0

    assert clock.now_s() == LOOK_S_MAX


def test_of_several_the_one_that_waits_longest_counts():
    before = {(1, 1): ThreadReading(False, 0.0, 0.0), (2, 2): ThreadReading(False, 0.0, 5.0)}
    now = {(1, 1): ThreadReading(False, 0.1, 0.2), (2, 2): ThreadReading(False, 0.0, 5.7)}

    assert waited_s(before, now, 1.0) == pytest.approx(0.7)
    assert waited_s({}, {}, 1.0) == 0.0
    assert waited_s({}, {(3, 3): ThreadReading(True, 0.25, 0.0)}, 1.0) == pytest.approx(0.75)
    assert waited_s({}, {(3, 3): ThreadReading(False, 0.0, 9.0)}, 1.0) == 1.0


def test_where_nothing_can_be_read_all_time_counts():
    machine = Machine()
    machine.has_ended = True

    assert advance(machine, machine.granted(), 10.0) == pytest.approx(10.0)


def test_looks_are_rare_enough_to_cost_little():
    machine, costly = Machine(), []

    def read(roots):
        machine.now_s += 0.01
        costly.append(machine.now_s)
        return {}

    clock = GrantedClock(lambda: (10,), read=read, clock=machine.clock)
    for _ in range(1000):
        machine.now_s += 0.01
        clock.now_s()

    assert len(costly) * 0.01 <= 0.05 * (machine.now_s - 100.0)


def child(code):
    return subprocess.Popen([sys.executable, "-c", code])


needs_proc = pytest.mark.skipif(not os.path.exists("/proc/self/schedstat"), reason="Linux's own")


@needs_proc
@pytest.mark.process
def test_a_real_tree_is_read_with_its_descendants():
    code = (
        "import subprocess, sys\n"
        "subprocess.run([sys.executable, '-c', 'print(1, flush=True); import time; time.sleep(60)'])"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        readings = read_trees([process.pid])
        process.kill()
        grandchildren = {pid for pid, _ in readings} - {process.pid}
        for pid in grandchildren:
            os.kill(pid, signal.SIGKILL)

    assert (process.pid, process.pid) in readings
    assert len(grandchildren) == 1


@needs_proc
@pytest.mark.process
def test_a_real_stop_counts_and_is_seen():
    process = child("import time; time.sleep(60)")
    try:
        clock = GrantedClock(lambda: (process.pid,))
        process.send_signal(signal.SIGSTOP)
        until_s = time.monotonic() + 60.0
        while clock.now_s() < 0.5 and time.monotonic() < until_s:
            time.sleep(0.05)

        assert clock.now_s() >= 0.5
        assert is_stopped(process.pid)
    finally:
        process.kill()
        process.wait()
    assert not is_stopped(process.pid)
