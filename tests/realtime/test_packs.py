"""Agents that tick together: who is in which pack, when it wakes, and that one deadline serves all."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from madns_runtime.config import Agents
from madns_runtime.realtime.packs import PACK_AGENTS_MAX, Pack, phase_of, split_into_packs


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


@pytest.mark.parametrize(("count", "per_process"), [(96, 48), (93, 47), (1000, 125), (24, 12)])
def test_packs_are_spread_over_the_period(count, per_process):
    agents = Agents(count=count, tick_hz=10.0, per_process=per_process)
    names = agents.resolved_names()
    phases = sorted(
        phase_of(number, pack, agents)
        for start in range(0, count, per_process)
        for number, pack in enumerate(split_into_packs(names[start : start + per_process]))
    )
    packs = -(-count // per_process) * -(-per_process // PACK_AGENTS_MAX)

    assert phases == pytest.approx([0.1 * number / packs for number in range(packs)])


def test_agents_by_themselves_keep_the_phases_they_had():
    agents = Agents(count=24, tick_hz=100.0)
    phases = sorted(phase_of(0, [name], agents) for name in agents.resolved_names())

    assert phases == pytest.approx([number / 24 / 100 for number in range(24)])


def test_aligned_packs_share_the_beginning_of_the_period():
    agents = Agents(count=24, tick_hz=100.0, per_process=24, phase="aligned")

    assert phase_of(2, ["agent-17"], agents) == 0.0


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

    def say_how_it_is(self, now_s):
        self.pings += 1


PROCESS = SimpleNamespace(
    begin=int, end=int, account=SimpleNamespace(begin_ticks=lambda now_s: None)
)


class Loop:
    def call_at(self, when_s, callback):
        self.timer = SimpleNamespace(when_s=when_s)
        self.timer.reschedule = lambda at_s: setattr(self.timer, "when_s", at_s)
        self.due = callback
        return self.timer


def pack_of(*members):
    loop = Loop()
    pack = Pack(0.0, reactor=loop, process=PROCESS)
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
