"""
Each tick that was missed or late has one cause, in whatever way a loop spends its time: with a simulated clock.

A loop of two agents lives through seeded chance: it sleeps too long, takes steps that compute or block, takes in
messages, collects garbage and pings. What it did is kept here as well, and judged by the written rule anew.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from types import SimpleNamespace

import pytest

from madns_runtime.realtime import loop_account, ticks
from madns_runtime.realtime.loop_account import NOBODY, LoopAccount, Span
from madns_runtime.realtime.ticks import PacedTicks, TickCalls
from madns_runtime.timing.late_causes import CAUSES, Cause
from madns_runtime.timing.rate import Pacer

TICK_HZ, DURATION_S, LATE_S = 100.0, 3.0, 0.001


class Clock:
    """Simulated time is the local clock's."""

    def __init__(self):
        self.now_s = 0.0
        self.computed_s = 0.0

    def compute(self, seconds):
        self.now_s += seconds
        self.computed_s += seconds

    def block(self, seconds):
        self.now_s += seconds


class Loop:
    """A loop with two agents of phases half a period apart, each by itself in its pack."""

    def __init__(self, monkeypatch, seed):
        self.clock = clock = Clock()
        self.chance = random.Random(seed)
        for module in (loop_account, ticks):
            monkeypatch.setattr(module, "monotonic", lambda: clock.now_s)
        monkeypatch.setattr(loop_account, "thread_time", lambda: clock.computed_s)
        for of in ("of_waiting", "of_stolen_time"):
            monkeypatch.setattr(loop_account.KernelFile, of, Nothing)
        self.lived = []
        """Cause, agent, begin and end of all that is timed."""
        self.reactor = SimpleNamespace(slept_s=0.0, sleeps=[(-math.inf, -math.inf)])
        writer = SimpleNamespace(computed_within_s=lambda window: 0.0)
        self.account = LoopAccount(self.reactor, writer, agents=2)
        self.records = {0: [], 1: []}
        self.agents = [self._agent(seat) for seat in (0, 1)]

    def _agent(self, seat):
        config = SimpleNamespace(
            agents=SimpleNamespace(tick_hz=TICK_HZ),
            time=SimpleNamespace(duration_s=DURATION_S),
            deadline=SimpleNamespace(overrun_ms=LATE_S * 1e3, lateness_limit_s=LATE_S),
        )
        port = SimpleNamespace(
            process=SimpleNamespace(account=self.account),
            conditions=SimpleNamespace(must_look=False, look=None),
            must_flush=False,
            at=lambda local_s: local_s,
            local_s=lambda t_s: t_s,
            has_rejoined=False,
        )
        calls = TickCalls(
            prepare=None,
            step=self._step,
            end_if_forked=lambda: None,
            failed=lambda error: pytest.fail(str(error)),
            ended=lambda: None,
            is_running=lambda: True,
            report_if_due=lambda now_s: None,
        )
        loop_seat = SimpleNamespace(calls=SimpleNamespace(page=[0.0] * 8), number=seat)
        recorder = SimpleNamespace(
            record=lambda stream, values: self.records[seat].append((stream, values))
        )
        phase_s = seat * 0.5 / TICK_HZ
        return PacedTicks(loop_seat, config, phase_s, port=port, recorder=recorder, calls=calls)

    def _step(self, tick):
        kind = self.chance.random()
        length_s = self.chance.choice((0.004, 0.012, 0.03))
        if kind < 0.04:
            self.clock.compute(length_s)
        elif kind < 0.08:
            self.clock.block(length_s)
        elif kind < 0.12:
            self._timed(Cause.GARBAGE, length_s)
        else:
            self.clock.compute(20e-6)

    def _timed(self, cause, length_s):
        span = Span(cause, NOBODY, self.clock.now_s, self.clock.now_s + length_s)
        self.clock.compute(length_s)
        self.account.add(span)
        self.lived.append(span)

    def _between(self):
        """Do something between ticks, now and then."""
        kind = self.chance.random()
        if kind < 0.1:
            cause = self.chance.choice((Cause.RECEIVING, Cause.HOUSEKEEPING))
            self._timed(cause, self.chance.choice((100e-6, 0.006, 0.025)))
        elif kind < 0.13:
            self.clock.compute(self.chance.choice((0.004, 0.03)))  # nobody times it

    def run(self):
        for agent in self.agents:
            agent.begin(0.0)
        while any(not agent.pacer.is_over for agent in self.agents):
            due_s = min(agent.next_deadline_s() for agent in self.agents)
            slept_from_s = self.clock.now_s
            if due_s > slept_from_s:
                overslept_s = self.chance.choice((50e-6, 50e-6, 50e-6, 0.004, 0.02))
                self.clock.now_s = due_s + overslept_s
                self.reactor.slept_s += self.clock.now_s - slept_from_s
                self.reactor.sleeps.append((slept_from_s, self.clock.now_s))
                self.lived.append(Span(Cause.WAKE_UP, NOBODY, slept_from_s, self.clock.now_s))
            for seat, agent in enumerate(self.agents):  # a pack each
                if agent.next_deadline_s() <= self.clock.now_s:
                    began_s = self.clock.now_s
                    self.account.begin_ticks(began_s)
                    agent.tick()
                    self.lived.append(Span(Cause.STEP, seat, began_s, self.clock.now_s))
            self._between()
        for agent in self.agents:
            agent.finish(self.clock.now_s)
        self.account.close()

    def cause_by_the_rule(self, seat, due_s, began_s):
        """Return the first cause that clearly filled half of a window; None if none did, or it is a matter of rounding."""
        filled_s, longest_s = dict.fromkeys(CAUSES, 0.0), 0.0
        together_s, until_s = 0.0, due_s
        for _, _, begin_s, end_s in sorted(self.lived, key=lambda span: span.begin_s):
            together_s += max(0.0, min(end_s, began_s) - max(begin_s, until_s))
            until_s = max(until_s, end_s)
        for cause, agent, begin_s, end_s in self.lived:
            within_s = min(end_s, began_s) - max(begin_s, due_s)
            if within_s <= 0.0:
                continue
            if cause is Cause.STEP and agent == seat:
                longest_s = max(longest_s, end_s - begin_s)
            filled_s[Cause.OTHER_AGENT if agent not in (seat, NOBODY) else cause] += within_s
        if longest_s < 1.0 / TICK_HZ:
            filled_s[Cause.TICK_BEFORE] = filled_s.pop(Cause.STEP)
        shares = {cause: filled_s.get(cause, 0.0) / (began_s - due_s) for cause in CAUSES}
        if any(abs(share - 0.5) < 0.01 for share in shares.values()):
            return None
        if together_s < 0.49 * (began_s - due_s):
            return Cause.UNEXPLAINED
        if together_s < 0.51 * (began_s - due_s):
            return None
        most = max(CAUSES, key=lambda cause: shares[cause])
        return next((cause for cause in CAUSES if shares[cause] > 0.5), most)


class Nothing:
    """A count of the kernel's that never grows."""

    def __call__(self):
        return 0.0

    def close(self):
        pass


def rows(records, stream):
    return [values for name, values in records if name == stream]


@pytest.mark.parametrize("seed", range(20))
def test_causes_add_up_to_missed_and_late_ticks_and_stand_in_the_records(monkeypatch, seed):
    loop = Loop(monkeypatch, seed)
    loop.run()

    for seat, agent in enumerate(loop.agents):
        told = rows(loop.records[seat], "ticks")
        late = rows(loop.records[seat], "late_ticks")
        counts = agent.late.counts()
        late_alone = sum(
            missed == 0 and lateness_us > LATE_S * 1e6 for _, lateness_us, _, missed in told
        )
        assert agent.pacer.missed > 0
        assert len(told) + agent.pacer.missed == agent.pacer.tick_count
        assert sum(counts.values()) == agent.pacer.missed + late_alone
        assert sum(missed for _, _, missed, _ in late) == agent.pacer.missed
        by_cause = {
            cause.value: sum(max(missed, 1) for _, _, missed, named in late if named == cause.value)
            for cause in CAUSES
        }
        assert counts == {cause: count for cause, count in by_cause.items() if count}
        indices = [index for index, *_ in late]
        assert indices == sorted(set(indices))


def test_the_cause_is_the_first_of_the_written_order_that_filled_half(monkeypatch):
    named = Counter()
    for seed in range(20):
        loop = Loop(monkeypatch, seed)
        loop.run()
        for seat, agent in enumerate(loop.agents):
            for index, lateness_us, missed, cause in rows(loop.records[seat], "late_ticks"):
                if index == agent.pacer.tick_count:
                    continue  # that no other followed: when it was looked for is not on record
                due_s = agent.pacer.deadline_of(index - missed)
                began_s = agent.pacer.deadline_of(index) + lateness_us * 1e-6
                expected = loop.cause_by_the_rule(seat, due_s, began_s)
                assert cause == (expected or cause), (seed, seat, index)
                named[expected] += 1

    causes = {Cause.GARBAGE, Cause.WAKE_UP, Cause.STEP, Cause.TICK_BEFORE, Cause.OTHER_AGENT}
    assert causes | {Cause.RECEIVING, Cause.HOUSEKEEPING, Cause.UNEXPLAINED} <= set(named)


def test_ticks_at_the_end_that_no_other_followed_are_recorded_with_their_cause(monkeypatch):
    loop = Loop(monkeypatch, 0)
    agent = loop.agents[0]
    agent.begin(0.0)
    last = agent.pacer.tick_count - 1
    loop.clock.now_s = agent.pacer.deadline_of(last - 6)
    agent.pacer.skip_to(loop.clock.now_s)
    agent._step = lambda tick: loop.clock.block(0.1)
    loop.account.begin_ticks(loop.clock.now_s)
    agent.tick()
    loop.account.begin_ticks(loop.clock.now_s)
    agent.tick()

    assert agent.pacer.is_over
    assert rows(loop.records[0], "late_ticks") == [(last + 1, 0, 6, "step")]
    assert agent.late.counts() == {"step": 6}


@pytest.mark.parametrize(("has_rejoined", "missed", "not_run"), [(False, 5, 0), (True, 0, 6)])
def test_first_ticks_that_an_order_to_start_came_too_late_for_are_missed_by_it(
    monkeypatch, has_rejoined, missed, not_run
):
    """Not so those of an agent that was not there: they were never its own."""
    loop = Loop(monkeypatch, 0)
    agent = loop.agents[0]
    agent._step = lambda tick: None
    agent._port.has_rejoined = has_rejoined
    loop.clock.now_s = agent.pacer.deadline_of(5) + 1e-3
    agent.begin(loop.clock.now_s)
    if has_rejoined:
        loop.clock.now_s = agent.next_deadline_s()
    loop.account.begin_ticks(loop.clock.now_s)
    agent.tick()

    summary = agent.pacer.summary()
    assert (summary["missed"], summary["not_run"]) == (missed, not_run)
    assert agent.late.counts() == ({"start": missed} if missed else {})


@pytest.mark.parametrize(("leap_s", "missed"), [(0.055, 5), (-0.055, 0), (100.0, 290)])
def test_ticks_that_a_leap_of_the_clock_has_skipped_are_its_own(monkeypatch, leap_s, missed):
    loop = Loop(monkeypatch, 0)
    agent = loop.agents[0]
    agent._step = lambda tick: None
    agent.begin(0.0)
    ahead_s = 0.0
    agent._port.at = lambda local_s: local_s + ahead_s
    for turn in range(20):
        if turn == 10:  # behind the wake-up, which was set by the clock before
            ahead_s = leap_s
        loop.account.begin_ticks(loop.clock.now_s)
        agent.tick()
        due_s = agent.pacer.next_deadline_s()
        if due_s is not None:
            loop.clock.now_s = max(loop.clock.now_s, due_s - ahead_s)

    assert agent.pacer.missed == missed
    assert agent.late.counts() == ({"clock": missed} if missed else {})


def test_the_last_tick_of_a_run_of_no_whole_periods_may_be_due_behind_its_end():
    ticks = PacedTicks.__new__(PacedTicks)
    ticks.duration_s = 8.5
    over_s = []
    for phase_s in (0.0, 2.0):
        ticks.pacer = Pacer(tick_hz=0.25, phase_s=phase_s, duration_s=8.5, overrun_s=0.0)
        over_s.append(ticks.over_s())

    assert over_s == [8.5, 10.0]
