"""Agents that tick together: who is in which pack, when it wakes, and that one deadline serves all."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from madns_runtime.realtime.packs import Pack
from madns_runtime.realtime.wake_lead import LEAD_S_MAX, WAIT_S_MAX, WakeLead
from madns_runtime.timing.pack_split import PACK_AGENTS_MAX, split_into_packs


@pytest.mark.parametrize(
    ("agents", "sizes"),
    [(1, [1]), (8, [8]), (9, [4, 5]), (47, [8, 8, 8, 7, 8, 8]), (50, [7, 7, 7, 8, 7, 7, 7])],
)
def test_packs_are_few_and_even(agents, sizes):
    names = [f"agent-{number}" for number in range(agents)]
    packs = split_into_packs(names)

    assert [name for pack in packs for name in pack] == names
    assert sorted(map(len, packs)) == sorted(sizes)
    assert max(map(len, packs)) <= PACK_AGENTS_MAX


class Member:
    def __init__(self, due_s):
        self.due_s = due_s
        self.ticks = self.pings = 0

    def next_deadline_s(self):
        return self.due_s

    def local_s(self, t_s):
        return 100.0 + t_s

    def tick(self):
        self.ticks += 1
        self.due_s += 0.5

    def report_if_due(self, now_s):
        self.pings += 1


PROCESS = SimpleNamespace(
    agents=8,
    begin=int,
    end=int,
    account=SimpleNamespace(begin_ticks=lambda now_s: None),
    clock=SimpleNamespace(changes=0),
)
ALONE = SimpleNamespace(**{**vars(PROCESS), "agents": 1})


class Loop:
    def __init__(self):
        self.sleeps = [(-math.inf, -math.inf)]

    def call_at(self, when_s, callback):
        self.timer = SimpleNamespace(when_s=when_s)
        self.timer.reschedule = lambda at_s: setattr(self.timer, "when_s", at_s)
        self.due = callback
        return self.timer


def pack_of(*members, process=PROCESS):
    loop = Loop()
    pack = Pack(0.0, reactor=loop, process=process)
    for member in members:
        pack.add(member)
    return loop, pack


def test_one_wake_up_ticks_all_and_is_set_for_the_next():
    members = [Member(1.0), Member(1.0), Member(math.inf)]
    loop, pack = pack_of(*members)
    assert loop.timer.when_s == math.inf

    pack.arm()
    assert loop.timer.when_s == 101.0
    loop.due()

    assert [member.ticks for member in members] == [1, 1, 1]
    assert loop.timer.when_s == 101.5


def test_it_wakes_for_whoever_is_due_first_and_no_more_when_nobody_is():
    early, late = Member(1.0), Member(3.0)
    loop, pack = pack_of(late, early)
    pack.arm()
    assert loop.timer.when_s == 101.0

    early.due_s = late.due_s = math.inf
    pack.arm()
    assert loop.timer.when_s == math.inf


def test_a_pack_says_how_it_is_with_its_ticks():
    member = Member(1.0)
    loop, _ = pack_of(member)

    loop.due()

    assert (member.ticks, member.pings) == (1, 1)


def test_an_agent_by_itself_says_how_it_is_behind_the_answer_to_its_tick():
    member = Member(1.0)
    loop, _ = pack_of(member, process=ALONE)
    ALONE.after_packet()

    loop.due()
    assert (member.ticks, member.pings) == (1, 1), "behind the packet before the tick"
    ALONE.after_packet()

    assert (member.ticks, member.pings) == (1, 2)


def test_an_agent_that_nobody_answers_says_how_it_is_with_its_next_tick():
    member = Member(1.0)
    loop, _ = pack_of(member, process=ALONE)

    loop.due()
    loop.due()

    assert (member.ticks, member.pings) == (2, 2)


class Clock:
    """A clock that goes on by so much with each look."""

    def __init__(self, monkeypatch, at_s, step_s):
        self.at_s, self.step_s = at_s, step_s
        monkeypatch.setattr("madns_runtime.realtime.packs.monotonic", self)

    def __call__(self):
        self.at_s += self.step_s
        return self.at_s


class Observer(Member):
    """Notes when it ticks."""

    def __init__(self, due_s, clock):
        super().__init__(due_s)
        self.clock, self.ticked_s = clock, []

    def tick(self):
        self.ticked_s.append(self.clock.at_s)
        super().tick()


def wake(loop, clock, *, took_s, is_asleep=True):
    """Let the loop's timer fire, so long before what follows."""
    clock.at_s = loop.timer.when_s + took_s
    loop.sleeps.append((0.0, clock.at_s) if is_asleep else (0.0, loop.timer.when_s - 1e-6))
    loop.due()


def test_it_wakes_ahead_of_its_deadline_by_what_waking_takes_and_ticks_at_it(monkeypatch):
    clock = Clock(monkeypatch, 100.0, 1e-7)
    member = Observer(1.0, clock)
    loop, pack = pack_of(member)
    pack.arm()
    for _ in range(200):
        wake(loop, clock, took_s=50e-6)

    late_s = [at_s - (101.0 + 0.5 * count) for count, at_s in enumerate(member.ticked_s)]
    assert late_s[0] == pytest.approx(50e-6, abs=1e-6)
    assert all(0.0 <= each < 6e-6 for each in late_s[-50:])
    assert member.due_s + 100.0 - loop.timer.when_s == pytest.approx(50e-6, abs=5e-6)


def test_it_waits_for_a_deadline_that_a_better_clock_has_moved_but_not_for_long(monkeypatch):
    clock = Clock(monkeypatch, 100.0, 1e-7)
    estimate = SimpleNamespace(changes=0)
    process = SimpleNamespace(**{**vars(PROCESS), "clock": estimate})
    member = Observer(1.0, clock)
    loop, pack = pack_of(member, process=process)
    pack.arm()
    monkeypatch.setattr(member, "local_s", lambda t_s: 100.00005 + t_s)
    estimate.changes += 1
    wake(loop, clock, took_s=10e-6)
    assert member.ticked_s == [pytest.approx(101.00005, abs=1e-6)]

    monkeypatch.setattr(member, "local_s", lambda t_s: 107.0 + t_s)
    estimate.changes += 1
    wake(loop, clock, took_s=10e-6)
    assert member.ticked_s[1] - loop.sleeps[-1][1] < WAIT_S_MAX


def test_a_wake_up_of_a_loop_that_was_at_work_tells_nothing(monkeypatch):
    clock = Clock(monkeypatch, 100.0, 1e-7)
    member = Observer(1.0, clock)
    loop, pack = pack_of(member)
    pack.arm()
    for _ in range(50):
        wake(loop, clock, took_s=80e-6, is_asleep=False)

    assert loop.timer.when_s == member.due_s + 100.0


@pytest.mark.parametrize("took_s", [1.5 * LEAD_S_MAX, 5 * LEAD_S_MAX])
def test_it_never_waits_for_long_however_slow_the_computer_wakes(took_s):
    lead = WakeLead()
    for _ in range(1000):
        lead.learn(took_s)

    assert lead.lead_s == LEAD_S_MAX


def test_lead_covers_nine_wake_ups_of_ten_and_late_ones_do_not_move_it():
    lead = WakeLead()
    for count in range(4000):
        lead.learn(10.0 if count % 2 else (count // 2 * 7 % 20) * 2e-6)
    assert lead.lead_s == pytest.approx(36e-6, abs=6e-6)

    for _ in range(100):
        lead.learn(0.0)
    assert lead.lead_s == 0.0
