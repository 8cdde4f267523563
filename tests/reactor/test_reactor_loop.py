import gc
import math
import os
import signal
import socket
import threading
import time

import pytest

from madns_runtime.errors import MachineError
from madns_runtime.reactor import libc
from madns_runtime.reactor import poller as poller_module
from madns_runtime.reactor import reactor as reactor_module
from madns_runtime.reactor.poller import EpollPoller, TimerFd
from madns_runtime.reactor.reactor import TIMERS_BATCH_MAX, Reactor

pytestmark = pytest.mark.process

LONG_S = 120.0
"""A guard that no test reaches: the loop stops by itself before it."""


class CallbackFailed(Exception):
    pass


@pytest.fixture(params=[False, True], ids=["timerfd", "portable"])
def reactor(request):
    reactor = Reactor(portable=request.param)
    guard = reactor.call_at(reactor.now_s() + LONG_S, reactor.stop)
    yield reactor
    assert reactor._is_closed or guard.when_s > reactor.now_s(), "the loop hung"
    reactor.close()


@pytest.fixture
def pipe():
    read_fd, write_fd = os.pipe()
    os.set_blocking(read_fd, False)
    yield read_fd, write_fd
    for fd in (read_fd, write_fd):
        try:
            os.close(fd)
        except OSError:
            continue


def open_descriptors():
    return len(os.listdir("/proc/self/fd"))


def test_timers_run_in_order_and_never_early(reactor):
    start_s = reactor.now_s()
    ran = []
    for name, delay_s in (("b", 0.02), ("a", 0.01), ("c", 0.02), ("d", 0.03)):
        when_s = start_s + delay_s
        reactor.call_at(when_s, lambda n=name, w=when_s: ran.append((n, reactor.now_s() >= w)))
    reactor.call_at(start_s + 0.03, reactor.stop)

    reactor.run()

    assert ran == [("a", True), ("b", True), ("c", True), ("d", True)]


def test_timer_of_the_past_runs_at_once(reactor):
    ran = []
    reactor.call_at(-1.0, lambda: ran.append("past"))
    reactor.call_at(0.0, reactor.stop)

    reactor.run()

    assert ran == ["past"]


@pytest.mark.parametrize("portable", [False, True])
@pytest.mark.parametrize("when_s", [1e10, 1e19, 1e300, float("inf")])
def test_timer_beyond_what_the_kernel_knows_is_never_and_harms_no_other(portable, when_s):
    reactor = Reactor(portable=portable)
    ran = []
    reactor.call_at(when_s, lambda: ran.append("far"))
    threading.Timer(0.02, lambda: reactor.call_soon_threadsafe(reactor.stop)).start()

    reactor.run()

    assert ran == []
    reactor.close()


def test_periodic_timer_keeps_its_absolute_deadlines(reactor):
    start_s = reactor.now_s()
    deadlines = []

    def tick():
        deadlines.append(timer.when_s)
        assert reactor.now_s() >= timer.when_s
        if len(deadlines) == 20:
            reactor.stop()
        else:
            timer.reschedule(start_s + len(deadlines) * 0.002)

    timer = reactor.call_at(start_s, tick)
    reactor.run()

    assert deadlines == [start_s + k * 0.002 for k in range(20)]


def test_cancelled_timer_does_not_run(reactor):
    ran = []
    timer = reactor.call_at(reactor.now_s() + 0.005, lambda: ran.append("cancelled"))
    reactor.call_at(0.0, timer.cancel)
    reactor.call_at(timer.when_s + 0.005, reactor.stop)

    reactor.run()

    assert ran == []


def test_same_deadline_set_again_after_it_fired_still_wakes(reactor):
    when_s = reactor.now_s() + 0.005
    ran = []

    def first():
        ran.append("first")
        reactor.call_at(when_s, second)

    def second():
        ran.append("second")
        reactor.call_at(reactor.now_s() + 0.005, reactor.stop)

    reactor.call_at(when_s, first)
    reactor.run()

    assert ran == ["first", "second"]


def test_reader_is_called_for_data_and_for_the_end(reactor, pipe):
    read_fd, write_fd = pipe
    seen = []

    def readable():
        data = os.read(read_fd, 100)
        seen.append(data)
        if data:
            os.close(write_fd)
        else:
            reactor.stop()

    reactor.add_reader(read_fd, readable)
    os.write(write_fd, b"hello")
    reactor.run()

    assert seen == [b"hello", b""]


def test_removed_reader_is_not_called(reactor, pipe):
    read_fd, write_fd = pipe
    reactor.add_reader(read_fd, lambda: pytest.fail("was removed"))
    os.write(write_fd, b"x")

    assert reactor.remove_reader(read_fd) is True
    assert reactor.remove_reader(read_fd) is False
    reactor.call_at(reactor.now_s() + 0.01, reactor.stop)
    reactor.run()


def test_reader_added_twice_is_replaced(reactor, pipe):
    read_fd, write_fd = pipe
    reactor.add_reader(read_fd, lambda: pytest.fail("was replaced"))
    reactor.add_reader(read_fd, reactor.stop)
    os.write(write_fd, b"x")

    reactor.run()


def test_descriptor_closed_before_removal_does_no_harm(reactor):
    read_fd, write_fd = os.pipe()
    reactor.add_reader(read_fd, lambda: pytest.fail("nothing was written"))
    os.close(read_fd)
    os.close(write_fd)

    assert reactor.remove_reader(read_fd) is True
    reactor.call_at(reactor.now_s(), reactor.stop)
    reactor.run()


def test_reader_may_remove_another_that_is_ready_as_well(reactor):
    left, right = socket.socketpair()
    other_left, other_right = socket.socketpair()
    called = []

    def readable(name, other):
        called.append(name)
        reactor.remove_reader(other.fileno())
        reactor.stop()

    reactor.add_reader(left.fileno(), lambda: readable("left", other_left))
    reactor.add_reader(other_left.fileno(), lambda: readable("other", left))
    right.send(b"x")
    other_right.send(b"x")
    reactor.run()

    assert len(called) == 1
    for end in (left, right, other_left, other_right):
        end.close()


def test_event_of_a_closed_descriptor_does_not_reach_its_successor(reactor):
    first = socket.socketpair()
    second = socket.socketpair()
    fresh = []
    called = []

    def replace(own, other):
        """Close the other ready socket, and let a new one take its number."""
        called.append("old")
        number = other[0].fileno()
        reactor.remove_reader(own[0].fileno())
        reactor.remove_reader(number)
        fresh.extend(socket.socketpair())
        os.dup2(fresh[0].fileno(), other[0].detach())
        reactor.add_reader(number, lambda: called.append("successor"))
        reactor.call_at(reactor.now_s() + 0.02, reactor.stop)
        fresh.append(number)

    reactor.add_reader(first[0].fileno(), lambda: replace(first, second))
    reactor.add_reader(second[0].fileno(), lambda: replace(second, first))
    first[1].send(b"x")
    second[1].send(b"x")
    reactor.run()

    assert called == ["old"]
    os.close(fresh.pop())
    for end in (*first, *second, *fresh):
        end.close()


def test_file_that_cannot_be_watched_counts_as_readable(reactor, tmp_path):
    path = tmp_path / "commands"
    path.write_bytes(b"one")
    seen = []
    with path.open("rb", buffering=0) as file:

        def readable():
            seen.append(file.read(100))
            if not seen[-1]:
                reactor.remove_reader(file.fileno())
                reactor.call_at(reactor.now_s() + 0.01, reactor.stop)

        reactor.add_reader(file.fileno(), readable)
        reactor.run()

    assert seen == [b"one", b""]


def test_due_timers_do_not_starve_sockets(reactor, pipe):
    read_fd, write_fd = pipe
    count = 0

    def again():
        nonlocal count
        count += 1
        assert count < 100 * TIMERS_BATCH_MAX
        timer.reschedule(0.0)

    timer = reactor.call_at(0.0, again)
    reactor.add_reader(read_fd, reactor.stop)
    os.write(write_fd, b"x")
    reactor.run()

    assert count <= TIMERS_BATCH_MAX


def test_busy_sockets_do_not_starve_timers(reactor):
    pairs = [socket.socketpair() for _ in range(20)]
    calls_before_timer = 0
    due = []

    def readable():
        nonlocal calls_before_timer
        calls_before_timer += 1
        assert calls_before_timer < 1000
        if not due:
            # Due from now on, while other sockets of the same round still wait.
            due.append(calls_before_timer)
            reactor.call_at(reactor.now_s(), reactor.stop)

    for receiver, sender in pairs:
        reactor.add_reader(receiver.fileno(), readable)
        sender.send(b"never read, so always readable")
    reactor.run()

    assert calls_before_timer == due[0]
    for pair in pairs:
        for end in pair:
            end.close()


def test_exception_leaves_run_and_what_else_was_due_stays_due(reactor, pipe):
    read_fd, write_fd = pipe
    ran = []

    def fail():
        ran.append("fail")
        raise CallbackFailed

    reactor.call_at(0.0, fail)
    reactor.call_at(0.0, lambda: ran.append("after"))
    reactor.add_reader(read_fd, reactor.stop)
    os.write(write_fd, b"x")

    with pytest.raises(CallbackFailed):
        reactor.run()
    assert ran == ["fail"]
    reactor.run()
    assert ran == ["fail", "after"]


def test_exception_of_a_reader_loses_no_timer(reactor, pipe):
    read_fd, write_fd = pipe
    ran = []

    def fail():
        os.read(read_fd, 10)
        raise CallbackFailed

    reactor.add_reader(read_fd, fail)
    os.write(write_fd, b"x")
    # The loop begins before, also where it has to wait for a processor.
    due_s = reactor.now_s() + 0.5
    reactor.call_at(due_s, lambda: ran.append("timer"))
    reactor.call_at(due_s, reactor.stop)

    with pytest.raises(CallbackFailed):
        reactor.run()
    time.sleep(0.52)  # the timer's event comes while nobody waits for it
    reactor.run()

    assert ran == ["timer"]


def test_stop_before_run_lets_it_return_at_once_and_only_once(reactor):
    ran = []
    reactor.stop()
    reactor.call_at(0.0, lambda: ran.append("timer"))

    reactor.run()
    assert ran == []
    reactor.call_at(0.0, reactor.stop)
    reactor.run()
    assert ran == ["timer"]


def test_stop_ends_a_batch_of_timers_and_of_readers(reactor):
    ran = []
    reactor.call_at(0.0, reactor.stop)
    reactor.call_at(0.0, lambda: ran.append("later"))
    reactor.run()
    assert ran == []

    pairs = [socket.socketpair() for _ in range(2)]
    for receiver, sender in pairs:
        reactor.add_reader(receiver.fileno(), lambda: (ran.append("reader"), reactor.stop()))
        sender.send(b"x")
    reactor.run()
    assert ran == ["later", "reader"]
    for pair in pairs:
        for end in pair:
            end.close()


def test_calls_of_other_threads_run_in_the_loop_in_order(reactor):
    ran = []
    count = 1000

    def work():
        for k in range(count):
            reactor.call_soon_threadsafe(lambda k=k: ran.append((k, threading.get_ident())))
        reactor.call_soon_threadsafe(reactor.stop)

    thread = threading.Thread(target=work)
    reactor.call_at(0.0, thread.start)
    reactor.run()
    thread.join()

    assert ran == [(k, threading.get_ident()) for k in range(count)]


def test_call_that_raises_does_not_lose_those_behind_it(reactor):
    ran = []

    def fail():
        raise CallbackFailed

    reactor.call_soon_threadsafe(fail)
    reactor.call_soon_threadsafe(lambda: ran.append("behind"))
    reactor.call_soon_threadsafe(reactor.stop)

    with pytest.raises(CallbackFailed):
        reactor.run()
    reactor.run()

    assert ran == ["behind"]


def test_calls_that_wait_are_bounded(reactor, monkeypatch):
    monkeypatch.setattr(reactor_module, "CALLS_MAX", 3)
    for _ in range(3):
        reactor.call_soon_threadsafe(reactor.stop)

    with pytest.raises(MachineError, match="3 calls wait"):
        reactor.call_soon_threadsafe(reactor.stop)


def test_call_after_close_does_nothing():
    reactor = Reactor()
    reactor.close()

    reactor.call_soon_threadsafe(lambda: pytest.fail("the loop is closed"))


def test_wakes_through_a_pipe_where_there_is_no_eventfd(monkeypatch):
    monkeypatch.delattr(os, "eventfd")
    reactor = Reactor(portable=True)
    for _ in range(200):
        reactor.call_soon_threadsafe(lambda: None)
    reactor.call_soon_threadsafe(reactor.stop)

    reactor.run()
    reactor.close()


def test_signal_is_handled_in_the_loop(reactor):
    ran = []
    reactor.on_signal(signal.SIGUSR1, lambda: (ran.append("usr1"), reactor.stop()))
    reactor.on_signal(signal.SIGUSR2, lambda: ran.append("usr2"))

    os.kill(os.getpid(), signal.SIGUSR2)
    os.kill(os.getpid(), signal.SIGUSR1)
    assert ran == []
    reactor.run()

    assert ran == ["usr2", "usr1"]


def test_signal_wakes_a_loop_that_waits(reactor):
    reactor.on_signal(signal.SIGALRM, reactor.stop)
    signal.setitimer(signal.ITIMER_REAL, 0.01)

    reactor.run()


def test_later_callback_of_a_signal_replaces_the_earlier(reactor):
    reactor.on_signal(signal.SIGUSR1, lambda: pytest.fail("was replaced"))
    reactor.on_signal(signal.SIGUSR1, reactor.stop)

    os.kill(os.getpid(), signal.SIGUSR1)
    reactor.run()


def test_signal_behind_one_whose_callback_raises_is_not_lost(reactor):
    def fail():
        raise CallbackFailed

    reactor.on_signal(signal.SIGUSR1, fail)
    reactor.on_signal(signal.SIGUSR2, reactor.stop)
    os.kill(os.getpid(), signal.SIGUSR1)
    os.kill(os.getpid(), signal.SIGUSR2)

    with pytest.raises(CallbackFailed):
        reactor.run()
    reactor.run()


def test_signals_are_noticed_once_and_others_are_not_taken_for_ours(reactor):
    ran = []
    mine = signal.signal(signal.SIGUSR2, lambda *_: ran.append("not the loop's"))
    reactor.on_signal(signal.SIGUSR1, lambda: ran.append("usr1"))
    os.kill(os.getpid(), signal.SIGUSR2)
    os.kill(os.getpid(), signal.SIGUSR1)
    os.kill(os.getpid(), signal.SIGUSR1)
    reactor._signals.dispatch()
    reactor._signals.dispatch()

    assert ran == ["not the loop's", "usr1"]
    signal.signal(signal.SIGUSR2, mine)


def test_close_restores_signals_as_they_were():
    seen = []
    before = signal.signal(signal.SIGUSR1, lambda *_: seen.append("mine"))
    wakeup_before = signal.set_wakeup_fd(-1)
    reactor = Reactor()
    reactor.on_signal(signal.SIGUSR1, lambda: pytest.fail("is closed"))

    reactor.close()
    os.kill(os.getpid(), signal.SIGUSR1)

    assert seen == ["mine"]
    assert signal.set_wakeup_fd(wakeup_before) == -1
    signal.signal(signal.SIGUSR1, before)


def test_closed_reactor_leaves_no_descriptor_open():
    gc.collect()  # what earlier tests left is not to be closed in the midst of this one
    before = open_descriptors()

    for portable in (False, True) * 20:
        reactor = Reactor(portable=portable)
        reactor.on_signal(signal.SIGUSR1, reactor.stop)
        reactor.call_at(0.0, reactor.stop)
        reactor.run()
        reactor.close()
        reactor.close()

    assert open_descriptors() <= before


def test_child_that_closes_its_copy_leaves_the_parents_loop_alone(reactor, pipe):
    read_fd, write_fd = pipe
    ran = []
    reactor.on_signal(signal.SIGUSR1, lambda: ran.append("signal"))
    reactor.add_reader(read_fd, lambda: (ran.append("reader"), os.read(read_fd, 10)))

    child = os.fork()
    if child == 0:
        reactor.close()
        os._exit(0 if signal.getsignal(signal.SIGUSR1) == signal.SIG_DFL else 1)
    _, status = os.waitpid(child, 0)
    os.write(write_fd, b"x")
    os.kill(os.getpid(), signal.SIGUSR1)
    reactor.call_at(reactor.now_s() + 0.01, lambda: ran.append("timer"))

    def look():
        if len(ran) >= 3:
            reactor.stop()
        else:
            reactor.call_at(reactor.now_s() + 0.01, look)

    reactor.call_at(0.0, look)
    reactor.run()

    assert os.waitstatus_to_exitcode(status) == 0
    assert sorted(ran) == ["reader", "signal", "timer"]


def test_timer_is_set_in_the_kernel_only_when_the_earliest_deadline_changes(monkeypatch):
    calls = []
    real_set = TimerFd.set
    monkeypatch.setattr(
        TimerFd, "set", lambda self, *times: (calls.append(times), real_set(self, *times))
    )
    reactor = Reactor()
    left, right = socket.socketpair()
    left.setblocking(False)
    wakeups = 0

    def readable():
        nonlocal wakeups
        wakeups += 1
        left.recv(10)
        watchdog.reschedule(reactor.now_s() + LONG_S)
        if wakeups == 50:
            reactor.stop()
        else:
            right.send(b"x")

    first_s = reactor.now_s() + LONG_S
    reactor.call_at(first_s, reactor.stop)
    watchdog = reactor.call_at(first_s + 1.0, reactor.stop)
    reactor.add_reader(left.fileno(), readable)
    right.send(b"x")
    reactor.run()

    assert wakeups == 50
    assert calls == [(first_s, 0.0)]
    reactor.close()
    left.close()
    right.close()


def test_timerfd_of_newer_pythons_is_used_where_present(monkeypatch):
    asked = []

    def create(clock, *, flags):
        asked.append((clock, flags))
        return libc.timerfd_create()

    monkeypatch.setattr(os, "timerfd_create", create, raising=False)
    monkeypatch.setattr(
        os,
        "timerfd_settime_ns",
        lambda fd, *, flags, initial, interval: asked.append((flags, initial, interval)),
        raising=False,
    )

    timer = TimerFd()
    timer.set(1.5)
    timer.set(-1.0)
    timer.set(float("inf"))
    timer.set(1.5, 0.01)
    timer.close()

    assert asked[0] == (time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
    assert asked[1:] == [
        (1, 1_500_000_000, 0),
        (1, 1, 0),
        (1, 0, 0),
        (1, 1_500_000_000, 10_000_000),
    ]


def test_many_ready_descriptors_all_get_their_turn(monkeypatch):
    monkeypatch.setattr(poller_module, "EVENTS_MAX", 4)
    reactor = Reactor()
    pairs = [socket.socketpair() for _ in range(30)]
    seen = set()

    def readable(receiver):
        seen.add(receiver.fileno())
        if len(seen) == len(pairs):
            reactor.stop()

    for receiver, sender in pairs:
        reactor.add_reader(receiver.fileno(), lambda receiver=receiver: readable(receiver))
        sender.send(b"never read")
    reactor.run()

    assert len(seen) == 30
    reactor.close()
    for pair in pairs:
        for end in pair:
            end.close()


def test_kernels_refusal_to_set_a_timer_is_an_error():
    with pytest.raises(OSError, match="settime"):
        libc.timerfd_settime(-1, libc.Itimerspec())


def test_poller_reports_nothing_when_its_deadline_has_passed():
    poller = EpollPoller()

    assert poller.wait(0.0) == []
    assert poller.wait(time.monotonic() + 0.005) == []
    poller.close()


PERIOD_S = 0.002


def deadlines(poller, first_s, count, period_s=PERIOD_S):
    """Wait for so many deadlines, one after the other; return by how much each was returned from too early, s."""
    early_s = []
    for number in range(count):
        until_s = first_s + number * period_s
        while (now_s := time.monotonic()) < until_s:
            assert poller.wait(until_s) == []
        early_s.append(until_s - now_s)
    return early_s


def test_deadlines_at_a_period_are_all_met_by_a_timer_that_repeats():
    poller = EpollPoller()
    poller.period_s = PERIOD_S

    early_s = deadlines(poller, time.monotonic() + PERIOD_S, 100)

    assert max(early_s) <= 0.0
    # Once, and again only where this loop itself slept through a deadline.
    assert poller.timer_settings <= 1 + sum(-late_s > PERIOD_S / 2 for late_s in early_s)
    poller.close()


def test_deadlines_that_leave_the_period_are_met_as_well():
    poller = EpollPoller()
    poller.period_s = PERIOD_S
    now_s = time.monotonic()

    early_s = deadlines(poller, now_s + PERIOD_S, 10)
    early_s += deadlines(poller, time.monotonic() + 0.3 * PERIOD_S, 10, 1.7 * PERIOD_S)
    early_s += deadlines(poller, time.monotonic() + 0.9 * PERIOD_S, 10, PERIOD_S + 20e-6)

    assert max(early_s) <= 0.0
    poller.close()


def test_a_timer_that_repeats_wakes_nobody_who_waits_for_something_else():
    poller = EpollPoller()
    poller.period_s = PERIOD_S
    deadlines(poller, time.monotonic() + PERIOD_S, 5)
    reader, writer = os.pipe()
    poller.register(reader)
    threading.Timer(20 * PERIOD_S, os.write, (writer, b"x")).start()

    ready = poller.wait(math.inf)

    assert ready == [reader]
    poller.close()
    os.close(reader)
    os.close(writer)


def test_periods_that_were_slept_through_are_counted_by_the_timer():
    poller = EpollPoller()
    poller.period_s = PERIOD_S
    first_s = time.monotonic() + PERIOD_S
    deadlines(poller, first_s, 1)
    time.sleep(5.5 * PERIOD_S)

    late_s = time.monotonic() - first_s
    following_s = first_s + math.ceil(late_s / PERIOD_S) * PERIOD_S
    early_s = deadlines(poller, following_s, 5)

    assert max(early_s) <= 0.0
    poller.close()
