"""What a loop did between a deadline and a late begin, with made-up spans of its time."""

from __future__ import annotations

import gc
import math
from time import monotonic
from types import SimpleNamespace

import pytest

from madns_runtime.realtime import loop_account
from madns_runtime.realtime.loop_account import NOBODY, LateTick, LoopAccount, Span
from madns_runtime.timing.late_causes import Cause

PERIOD_S = 0.010
ME, OTHER = 0, 1


class Counted:
    """A file of the kernel's, as a test has it count."""

    def __init__(self, kernel, name):
        self.kernel, self.name = kernel, name

    def __call__(self):
        return self.kernel[self.name]

    def close(self):
        pass


@pytest.fixture
def loop(monkeypatch):
    """A loop that sleeps when it is told to, and its writer of records; the machine is never busy."""
    kernel = {"waited": 0.0, "stolen": 1.0}  # of a machine from which something was stolen once
    for name, of in (("waited", "of_waiting"), ("stolen", "of_stolen_time")):
        monkeypatch.setattr(loop_account.KernelFile, of, lambda name=name: Counted(kernel, name))
    # Whatever keeps this test off its processor keeps no loop off its own.
    monkeypatch.setattr(loop_account, "thread_time", monotonic)
    reactor = SimpleNamespace(slept_s=0.0, sleeps=[(-9.0, -9.0)])
    writer = SimpleNamespace(computed_s=0.0)
    writer.computed_within_s = lambda window: min(writer.computed_s, window[1] - window[0])
    gc.disable()  # a collection of this process's own, that has to wait for a processor, would fill a window
    account = LoopAccount(reactor, writer, agents=2)
    yield SimpleNamespace(reactor=reactor, writer=writer, account=account, kernel=kernel)
    account.close()
    gc.enable()


def late_by(window_s, *, started_s=0.0):
    """A tick of mine that has just begun, so much too late."""
    now_s = monotonic()
    return LateTick(ME, now_s - window_s, now_s, started_s, PERIOD_S)


@pytest.mark.parametrize(
    ("cause", "agent", "lasted_s", "named"),
    [
        (Cause.STEP, ME, 0.020, Cause.STEP),
        (Cause.STEP, ME, 0.009, Cause.TICK_BEFORE),
        (Cause.STEP, OTHER, 0.009, Cause.OTHER_AGENT),
        (Cause.RECEIVING, NOBODY, 0.009, Cause.RECEIVING),
        (Cause.HOUSEKEEPING, ME, 0.009, Cause.HOUSEKEEPING),
        (Cause.GARBAGE, NOBODY, 0.009, Cause.GARBAGE),
    ],
)
def test_what_the_loop_did_is_the_cause(loop, cause, agent, lasted_s, named):
    late = late_by(0.008)
    loop.account.add(Span(cause, agent, late.began_s - lasted_s, late.began_s))

    assert loop.account.explain(late) is named


def test_a_loop_that_slept_over_its_deadline_was_woken_late(loop):
    late = late_by(0.008)
    loop.reactor.sleeps.append((late.due_s - 0.001, late.began_s))

    assert loop.account.explain(late) is Cause.WAKE_UP


def test_a_loop_that_was_woken_late_and_waited_once_more_for_what_had_come_was_woken_late(loop):
    late = late_by(0.008)
    loop.reactor.sleeps.append((late.due_s - 0.001, late.due_s + 0.007))
    loop.reactor.sleeps.append((late.due_s + 0.0071, late.due_s + 0.0072))

    assert loop.account.explain(late) is Cause.WAKE_UP


def test_what_held_up_two_packs_is_the_cause_of_both(loop, monkeypatch):
    clock = SimpleNamespace(now_s=monotonic(), computed_s=0.0)
    monkeypatch.setattr(loop_account, "monotonic", lambda: clock.now_s)
    monkeypatch.setattr(loop_account, "thread_time", lambda: clock.computed_s)
    for each in (loop.account._waited, loop.account._stolen):
        monkeypatch.setattr(each, "_now_s", lambda: clock.now_s)
    for _ in range(3):  # when all was well
        clock.now_s += PERIOD_S
        loop.reactor.slept_s += PERIOD_S
        loop.account.begin_ticks(clock.now_s)
    due_s = clock.now_s + 0.001
    clock.now_s += 0.020
    loop.kernel["waited"] += 0.020
    causes = []
    for agent in (ME, OTHER):
        loop.account.begin_ticks(clock.now_s)
        began_s, clock.now_s = clock.now_s, clock.now_s + 0.0005
        clock.computed_s += 0.0005
        loop.account.add(Span(Cause.STEP, agent, began_s, clock.now_s))
        causes.append(loop.account.explain(LateTick(agent, due_s, began_s, 0.0, PERIOD_S)))

    assert causes == [Cause.WAKE_UP, Cause.WAKE_UP]


def test_a_writer_that_computed_while_the_loop_was_to_wake_is_the_cause(loop):
    late = late_by(0.008)
    loop.reactor.sleeps.append((late.due_s - 0.001, late.began_s))
    loop.writer.computed_s = 0.006

    assert loop.account.explain(late) is Cause.RECORDING


@pytest.fixture
def clock(loop, monkeypatch):
    """Time, s, that passes as a test says, and in which the loop computes nothing."""
    clock = SimpleNamespace(now_s=monotonic())
    monkeypatch.setattr(loop_account, "monotonic", lambda: clock.now_s)
    monkeypatch.setattr(loop_account, "thread_time", float)
    for each in (loop.account._waited, loop.account._stolen):
        monkeypatch.setattr(each, "_now_s", lambda: clock.now_s)
    return clock


def sleep_until(loop, clock, due_s, late_s=0.0):
    """Sleep, begin ticks and return the one of mine that was due then."""
    slept_from_s, clock.now_s = clock.now_s, due_s + late_s
    loop.reactor.slept_s += clock.now_s - slept_from_s
    loop.reactor.sleeps.append((slept_from_s, clock.now_s))
    loop.account.begin_ticks(clock.now_s)
    return LateTick(ME, due_s, clock.now_s, 0.0, PERIOD_S)


@pytest.mark.parametrize(
    ("others_s", "named"),
    [
        ({"waited": 0.004}, Cause.WAKE_UP),
        ({"written": 0.004}, Cause.RECORDING),
        ({"waited": 0.001}, Cause.STOLEN),
        ({"waited": math.inf}, Cause.STOLEN),
    ],
)
@pytest.mark.parametrize("stolen_s", [0.01, 0.02])
def test_what_was_stolen_is_the_cause_of_no_more_than_nothing_else_explains(
    loop, clock, stolen_s, others_s, named
):
    """Counted is what was stolen from all processors since a while before the tick, and seven others were in time."""
    due_s = clock.now_s + PERIOD_S
    sleep_until(loop, clock, due_s)
    loop.kernel["stolen"] += stolen_s
    for number in range(1, 8):
        sleep_until(loop, clock, due_s + number * PERIOD_S)
    loop.kernel["waited"] += others_s.get("waited", 0.0)
    loop.writer.computed_s = others_s.get("written", 0.0)

    late = sleep_until(loop, clock, due_s + 8 * PERIOD_S, late_s=0.004)

    assert loop.account.explain(late) is named


@pytest.mark.parametrize("count", ["waited", "stolen"])
def test_a_step_that_blocks_is_not_charged_with_what_the_kernel_counted_long_before(
    loop, clock, count
):
    # A second in which the loop slept, and waited now and then for a processor.
    for _ in range(100):
        clock.now_s += PERIOD_S
        loop.reactor.slept_s += PERIOD_S
        loop.kernel[count] += 0.002
        loop.account.begin_ticks(clock.now_s)
    due_s = clock.now_s + PERIOD_S
    began_s, clock.now_s = clock.now_s, clock.now_s + 10 * PERIOD_S
    loop.account.add(Span(Cause.STEP, ME, began_s, clock.now_s))
    loop.kernel[count] += 0.002
    loop.account.begin_ticks(clock.now_s)

    assert loop.account.explain(LateTick(ME, due_s, clock.now_s, 0.0, PERIOD_S)) is Cause.STEP


def test_a_tick_due_while_another_late_one_was_looked_at_is_of_housekeeping(loop, monkeypatch):
    clock = SimpleNamespace(now_s=monotonic())
    monkeypatch.setattr(loop_account, "monotonic", lambda: clock.now_s)
    first = LateTick(ME, clock.now_s - 0.008, clock.now_s, 0.0, PERIOD_S)
    clock.now_s += 0.001
    loop.account.add(Span(Cause.STEP, ME, first.began_s, clock.now_s))

    def look():
        clock.now_s += 0.005

    monkeypatch.setattr(loop.account, "look", look)
    loop.account.explain(first)
    loop.account.begin_ticks(clock.now_s)
    next_one = LateTick(OTHER, clock.now_s - 0.004, clock.now_s, 0.0, PERIOD_S)

    assert loop.account.explain(next_one) is Cause.HOUSEKEEPING


def test_an_agent_that_began_after_its_deadline_was_started_late(loop):
    now_s = monotonic()

    assert (
        loop.account.explain(LateTick(ME, now_s - 0.008, now_s, now_s - 0.001, PERIOD_S))
        is Cause.START
    )


def test_what_nobody_timed_is_unexplained(loop):
    late = late_by(0.008)
    loop.account.add(Span(Cause.STEP, ME, late.due_s - 0.005, late.due_s - 0.001))

    assert loop.account.explain(late) is Cause.UNEXPLAINED


def test_a_collection_within_a_step_fills_no_more_than_the_step(loop):
    late = late_by(0.010)
    loop.account.add(Span(Cause.GARBAGE, NOBODY, late.due_s, late.due_s + 0.003))
    loop.account.add(Span(Cause.STEP, ME, late.due_s - 0.005, late.due_s + 0.004))

    # Together 4 ms of 10, though 3 and 4 are more than half.
    assert loop.account.explain(late) is Cause.UNEXPLAINED


def test_agents_of_a_pack_are_looked_at_once_and_each_has_its_own_cause(loop, monkeypatch):
    looks = []
    monkeypatch.setattr(loop.account, "look", lambda: looks.append(1))
    first = late_by(0.008)
    loop.account.add(Span(Cause.STEP, OTHER, first.began_s - 0.009, first.began_s))
    loop.account.begin_ticks(first.began_s)

    causes = [loop.account.explain(first._replace(agent=agent)) for agent in (ME, OTHER, ME)]

    assert causes == [Cause.OTHER_AGENT, Cause.TICK_BEFORE, Cause.OTHER_AGENT]
    assert len(looks) == 1


def test_what_a_pack_did_since_its_first_is_of_other_agents(loop):
    first = late_by(0.001)
    loop.reactor.sleeps.append((first.due_s - 0.001, first.began_s))
    loop.account.begin_ticks(first.began_s)
    after_a_step = first._replace(agent=OTHER, began_s=first.began_s + 0.005)

    assert loop.account.explain(first) is Cause.WAKE_UP
    assert loop.account.explain(after_a_step) is Cause.OTHER_AGENT


def test_another_wake_up_is_looked_at_anew(loop):
    late = late_by(0.008)
    loop.account.begin_ticks(late.began_s)
    assert loop.account.explain(late) is Cause.UNEXPLAINED

    loop.account.add(Span(Cause.RECEIVING, NOBODY, late.due_s, late.began_s))
    loop.account.begin_ticks(late.began_s)

    assert loop.account.explain(late) is Cause.RECEIVING


def test_a_collection_while_spans_are_looked_at_is_noted_and_disturbs_nothing(loop, monkeypatch):
    late = late_by(0.008)
    for _ in range(3):
        loop.account.add(Span(Cause.RECEIVING, NOBODY, late.due_s, late.began_s))
    overlap_s = loop_account.overlap_s

    def collect_first(*arguments):
        gc.collect()
        return overlap_s(*arguments)

    monkeypatch.setattr(loop_account, "overlap_s", collect_first)

    assert loop.account.explain(late) is Cause.RECEIVING
    assert any(span.cause is Cause.GARBAGE for span in loop.account._spans)


def test_a_collection_at_any_allocation_ends_no_look(loop):
    late = late_by(0.008)
    loop.account.add(Span(Cause.RECEIVING, NOBODY, late.due_s, late.began_s))
    thresholds = gc.get_threshold()
    gc.set_threshold(1)
    gc.enable()
    try:
        for _ in range(100):
            loop.account.explain(late)
            loop.account.begin_ticks(late.began_s)
    finally:
        gc.set_threshold(*thresholds)

    assert any(span.cause is Cause.GARBAGE for span in loop.account._spans)


def test_collections_are_noted_until_the_account_is_closed():
    reactor = SimpleNamespace(slept_s=0.0, sleeps=[(-9.0, -9.0)])
    gc.disable()  # but for this test's own
    try:
        account = LoopAccount(reactor, SimpleNamespace(), agents=1)
        gc.collect()
        spans = [span for span in account._spans if span.cause is Cause.GARBAGE]
        account.close()
        gc.collect()
    finally:
        gc.enable()

    assert len(spans) == 1
    assert spans[0].end_s >= spans[0].begin_s
    assert len(account._spans) == 1
