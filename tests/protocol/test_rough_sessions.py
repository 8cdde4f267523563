"""Whole runs amid bursts of loss, reordering, repeats, stalls, exits and returns: each comes to an end."""

from __future__ import annotations

import heapq
import random

import pytest
from test_sessions import World

from madns_runtime.protocol import events as h
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.states import AgentState, HostState

LONGEST_S = 60.0
"""All waits of a run one behind the other, and what the stalls of the test add."""


class RoughWorld(World):
    """A wire that repeats and reorders, with times at which it carries nothing; in some runs for good."""

    def __init__(self, names, seed):
        chance = random.Random(seed)
        super().__init__(
            names,
            policy=chance.choice(("abort", "continue")),
            loss=chance.choice((0.0, 0.05, 0.3)),
            seed=seed,
        )
        self.chance = chance
        self.duplication = chance.choice((0.0, 0.2, 1.0))
        self.jitter_s = chance.choice((0.004, 0.05, 0.6))
        self.dead_until_s = 0.0
        self.joins = []

    def post(self, target, data, source):
        if self.now_s < self.dead_until_s or self.random.random() < self.loss:
            return
        is_twice = target not in self.frozen and self.random.random() < self.duplication
        for _ in range(1 + is_twice):
            self.count += 1
            arrives_s = self.now_s + 0.001 + self.jitter_s * self.random.random()
            heapq.heappush(self.flight, (arrives_s, self.count, target, data, source))

    def disturb(self):
        """Let something go wrong, now and then."""
        chance, name = self.chance, self.chance.choice(self.names)
        draw = chance.random()
        if draw < 0.004:
            self.dead_until_s = self.now_s + chance.choice((0.2, 1.0, 2.2))
        elif draw < 0.007:
            self.frozen.add(name)
        elif draw < 0.015:
            self.frozen.clear()
        elif draw < 0.017 and name in self.agents:
            self.host.agent_exited(name, "killed", self.now_s)
            del self.agents[name]
            self.frozen.discard(name)
            self.joins.append((self.now_s + 2 * chance.random(), name))
        elif draw < 0.018:
            self.join(name)
        elif draw < 0.0185:
            self.now_s += chance.choice((0.9, 1.5, 4.0))
        for join in [one for one in self.joins if one[0] <= self.now_s]:
            self.joins.remove(join)
            self.join(join[1])

    def talk(self, number):
        """Send something reliable both ways, to and from whoever is there."""
        name = self.chance.choice(self.names)
        service = self.chance.choice((Service.RELIABLE, Service.SYNC))
        self.host.send(name, number, service, self.now_s)
        session = self.agents.get(name)
        if session is not None and session.state is AgentState.RUN_SIMULATION:
            session.send(number, service, self.now_s)


@pytest.mark.parametrize("seed", range(24))
def test_every_run_ends_on_both_sides_and_takes_no_message_twice(seed):
    w = RoughWorld(tuple(f"agent-{i}" for i in range(1, 2 + seed % 4)), seed)
    for name in w.names:
        if w.chance.random() < 0.85:
            w.join(name)
        else:
            w.joins.append((w.now_s + 8 * w.chance.random(), name))
    end_s = w.now_s + LONGEST_S
    dies_s = w.now_s + (20 * w.chance.random() ** 2 if seed % 2 else LONGEST_S)

    number = 0
    while w.host.state is not HostState.EXIT and w.now_s < end_s:
        if w.now_s < dies_s:
            w.disturb()
            number += 1
            w.talk(number)
        else:
            w.dead_until_s = end_s + LONGEST_S  # nobody hears of anybody any more
        w.run_for(0.02)
    assert w.host.state is HostState.EXIT
    w.frozen.clear()
    w.run_for(20)

    assert {s.state for s in w.agents.values()} <= {AgentState.EXIT}
    numbers = [e.payload for e in w.host_events if isinstance(e, h.AgentDataReceived)]
    assert len(numbers) == len(set(numbers))
