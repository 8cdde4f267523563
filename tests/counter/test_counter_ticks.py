"""The counting benchmark on ticks of its own, as the thesis's: pure halves, a clock that moves when told."""

import math
from types import SimpleNamespace

import pytest

from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.counter.agent import CounterAgent
from madns_runtime.simulations.counter.answer_times import PENDING_MAX, AnswerTimes
from madns_runtime.simulations.counter.host import CounterHost
from madns_runtime.simulations.counter.parameters import CounterParameters, declared_streams

AGENTS = ("a", "b")


class World:
    """Both halves with nothing between them; messages arrive at once."""

    def __init__(self, of_agents=None, **parameters):
        self.now = 0.0
        self.records = []
        self.services = []
        self.sent = 0
        chosen = CounterParameters(**parameters)
        self.own = dict.fromkeys(AGENTS, chosen) | (of_agents or {})
        self.host = CounterHost()
        self.host.setup(self._context(chosen, self._to_agent))
        self.agents = {name: CounterAgent() for name in AGENTS}
        for name, agent in self.agents.items():
            agent.setup(self._context(self.own[name], self._to_host, name), {})

    def _context(self, parameters, send, name="host"):
        return SimpleNamespace(
            agents=AGENTS,
            duration_s=20.0,
            parameters=parameters,
            agent_parameters=self.own,
            now_s=lambda: self.now,
            send=lambda to, message, service: send(name, to, message, service),
            open_stream=lambda stream, fields: None,
            record=lambda stream, values: self.records.append((stream, name, *values)),
            hardware={},
        )

    def _to_agent(self, name, to, message, service):
        self.services.append((to, service))
        self.agents[to].receive(message)

    def _to_host(self, name, to, message, service):
        self.sent += 1
        self.host.receive(name, message)

    def play(self, ticks, hz, until_s=math.inf):
        """Tick agents, staggered over the period, and the host when it wants to."""
        due = self.host.timer(-0.5)
        events = [
            ((k + i / len(AGENTS)) / hz, name, k)
            for k in range(ticks)
            for i, name in enumerate(AGENTS)
        ]
        for t_s, name, k in sorted(events):
            while due is not None and due <= t_s:
                self.now = due
                due = self.host.timer(due)
            self.now = t_s
            self.agents[name].step(SimpleNamespace(index=k))
        if due is not None and due <= until_s:
            self.now = due
            self.host.timer(due)
        if math.isfinite(until_s):
            self.now = until_s

    def trips(self, stream):
        return [record[-1] for record in self.records if record[0] == stream]


def test_on_ticks_a_round_trip_takes_one_period_for_both():
    world = World(answer_hz=20.0, read_on_tick=True, host_round_trips=True)

    world.play(10, 20.0)

    assert set(world.trips("round_trips")) == {50_000}
    assert set(world.trips("answer_round_trips")) == {50_000}
    # The answer to the last packet is read at no tick; the host knows of it no more than of the one before.
    assert len(world.trips("round_trips")) == len(world.trips("answer_round_trips")) == 2 * 9
    for agent in world.agents.values():
        summary = agent.finish()
        assert (summary["sent"], summary["returned"], summary["lost"]) == (10, 10, 0)
        assert summary["unread_refused"] == summary["wrong_values"] == 0
    assert world.host.finish() == {
        "returned": 20,
        "ticks": 11,
        "ticks_missed": 0,
        "unanswered": 0,
        "refused": 0,
        "answers_not_seen": 0,
    }


def test_at_once_is_the_default_and_knows_of_no_ticks():
    world = World()

    world.play(10, 20.0)

    assert world.trips("round_trips") == [0] * 20
    assert world.host.finish() == {"returned": 20}
    assert "unread_refused" not in world.agents["a"].finish()
    assert [s.name for s in declared_streams(CounterParameters(), AGENTS)] == ["round_trips"]


def test_each_agent_is_answered_in_the_class_of_service_of_its_own_packets():
    own = {"b": CounterParameters(service="sync")}
    for answer_hz in (0.0, 20.0):
        world = World(of_agents=own, answer_hz=answer_hz)

        world.play(2, 20.0)

        assert set(world.services) == {("a", Service.BEST), ("b", Service.SYNC)}


@pytest.mark.parametrize(("ticks", "unanswered"), [(9, 0), (13, 4)])
def test_what_the_host_still_holds_at_the_end_is_not_lost(ticks, unanswered):
    # The host's last tick before the end is at (2 - 1/4) / 2 s.
    world = World(answer_hz=2.0)

    world.play(ticks, 10.0, until_s=1.3)

    for agent in world.agents.values():
        summary = agent.finish()
        assert summary["sent"] == ticks == summary["returned"] + summary["unanswered"]
        assert (summary["lost"], summary["unanswered"]) == (0, unanswered)
        assert all(check["passed"] for check in summary["checks"])
    assert world.host.finish()["unanswered"] == unanswered * len(AGENTS)


def test_host_that_was_held_up_counts_its_missed_ticks():
    world = World(answer_hz=10.0)
    world.host.timer(-0.5)

    world.now = 0.56
    following = world.host.timer(0.075)

    assert following == pytest.approx((6 - 0.25) / 10.0)
    assert world.host.finish()["ticks_missed"] == 4


def test_answers_that_were_overtaken_are_counted():
    times = AnswerTimes()
    for packet in range(3):
        times.answered("a", packet, float(packet))

    assert times.seen("a", 2) == 2.0
    assert times.seen("a", 2) is None
    assert times.seen("a", -1) is None
    assert times.seen("b", 0) is None
    assert times.not_seen == 2


def test_answers_of_which_nothing_is_heard_are_bounded():
    times = AnswerTimes()
    for packet in range(PENDING_MAX + 5):
        times.answered("a", packet, 0.0)

    assert times.not_seen == 5
    assert times.seen("a", 4) is None


def test_overfull_waiting_rooms_are_counted(monkeypatch):
    monkeypatch.setattr("madns_runtime.simulations.counter.host.WAITING_MAX", 3)
    monkeypatch.setattr("madns_runtime.simulations.counter.agent.UNREAD_MAX", 1)
    world = World(answer_hz=1.0, read_on_tick=True)
    for k in range(5):
        world.agents["a"].step(SimpleNamespace(index=k))

    world.now = 0.75
    world.host.timer(0.75)

    assert world.host.finish()["refused"] == 2
    summary = world.agents["a"].finish()
    assert (summary["returned"], summary["lost"], summary["unread_refused"]) == (1, 4, 2)
