"""The quick way of a tick's messages: the same promises as the general one, and the same account."""

import random

import numpy as np
import pytest
from test_sessions import World

from madns_runtime.protocol import events as a
from madns_runtime.protocol import events as h
from madns_runtime.protocol.codec import NO_DATA, UnencodableValue
from madns_runtime.protocol.datagram import BEST_BYTES_MAX
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.states import HostState


class QuickWorld(World):
    """Hands datagrams in by the quick way, and sends each tick's message by it where it is open."""

    def __init__(self, names, **options):
        super().__init__(names, **options)
        self.up = {name: [] for name in names}
        self.down = {name: [] for name in names}
        self.quick_sent = 0
        self.tick = 0
        self.corrupt = 0.0

    def deliver_to_host(self, data, source):
        got = self.host.receive_data(self.noisy(data), (source,), self.now_s)
        if got is not None:
            self.up[got[0]].append(got[1])

    def deliver_to_agent(self, name, data):
        payload = self.agents[name].receive_data(self.noisy(data), self.now_s)
        if payload is not NO_DATA:
            self.down[name].append(payload)

    def noisy(self, data):
        if self.random.random() >= self.corrupt:
            return data
        position = self.random.randrange(len(data))
        return data[:position] + bytes([data[position] ^ 0x40]) + data[position + 1 :]

    def send_tick(self):
        """Send one message in each direction for every agent, and let the wire move."""
        self.tick += 1
        for name, session in self.agents.items():
            data = session.seal_data([self.tick, 0.5], self.now_s)
            if data is None:
                session.send([self.tick, 0.5], Service.BEST, self.now_s)
            else:
                self.quick_sent += 1
                self.post("host", data, name)
            sealed = self.host.seal_data(name, {"tick": self.tick}, self.now_s)
            if sealed is None:
                self.host.send(name, {"tick": self.tick}, Service.BEST, self.now_s)
            else:
                self.quick_sent += 1
                self.post(sealed[1][0], sealed[0], "host")
        self.run_for(0.01)

    def all_up(self, name):
        general = [e.payload for e in self.host_events if isinstance(e, h.AgentDataReceived)]
        return sorted(p[0] for p in self.up[name] + general)


def running(count=1, **options):
    names = tuple(f"agent-{i}" for i in range(1, count + 1))
    w = QuickWorld(names, **options)
    for name in names:
        w.join(name)
    while any(p.phase is not Phase.RUNNING for p in w.host.peers.values()):
        w.run_for(0.05)
    w.run_for(0.6)  # until simulated time runs, and clocks are no longer learnt in haste
    return w


def test_ticks_take_the_quick_way_both_ways_and_all_arrive():
    w = running()

    for _ in range(100):
        w.send_tick()
    w.run_for(0.1)

    assert w.all_up("agent-1") == list(range(1, 101))
    assert [p["tick"] for p in w.down["agent-1"]] == sorted(p["tick"] for p in w.down["agent-1"])
    assert w.quick_sent > 150
    assert len(w.up["agent-1"]) > 75


@pytest.mark.parametrize(("loss", "corrupt"), [(0.2, 0.0), (0.0, 0.1), (0.1, 0.05)])
def test_account_of_a_bad_wire_is_that_of_the_general_way(loss, corrupt):
    w = running(count=2)
    w.loss, w.corrupt = loss, corrupt

    for _ in range(200):
        w.send_tick()
    w.loss = w.corrupt = 0.0
    for _ in range(5):
        w.send_tick()
    w.run_for(0.3)

    for name, session in w.agents.items():
        peer = w.host.peers[name]
        for sender, receiver in ((session.link, peer.link), (peer.link, session.link)):
            sent, got = sender.counters.best, receiver.counters.best
            assert got.received + got.lost + got.late == sent.sent
            assert got.received < sent.sent
            refused = receiver.counters.refused
            assert (sum(refused.values()) > 0) == (corrupt > 0)


def test_forged_and_repeated_datagrams_bring_nothing():
    w = running()
    session = w.agents["agent-1"]
    data = session.seal_data(["once"], w.now_s)
    generator = random.Random(4)

    first = w.host.receive_data(data, ("agent-1",), w.now_s)
    again = w.host.receive_data(data, ("agent-1",), w.now_s)
    for _ in range(500):
        forged = bytearray(session.seal_data(["forged"], w.now_s))
        forged[generator.randrange(len(forged))] ^= 1 << generator.randrange(8)
        assert w.host.receive_data(bytes(forged), ("agent-1",), w.now_s) is None
    for length in range(0, 120):
        assert w.host.receive_data(bytes(length), ("agent-1",), w.now_s) is None

    assert first == ("agent-1", ["once"])
    assert again is None
    assert w.host.next_event() is None
    link = w.host.peers["agent-1"].link
    assert link.counters.refused["replay"] >= 1
    assert w.host.peers["agent-1"].phase is Phase.RUNNING


def test_reliable_data_beside_the_quick_way_arrives_once_and_in_order():
    w = running(loss=0.0, seed=7)
    w.loss = 0.15
    for number in range(60):
        w.agents["agent-1"].send({"n": number}, Service.RELIABLE, w.now_s)
        w.host.send("agent-1", {"n": number}, Service.SYNC, w.now_s)
        w.send_tick()
    w.loss = 0.0
    w.run_for(2)

    up = [e.payload["n"] for e in w.host_events if is_numbered(e, h.AgentDataReceived)]
    down = [e.payload["n"] for e in w.agent_events["agent-1"] if is_numbered(e, a.HostDataReceived)]
    assert up == list(range(60))
    assert down == list(range(60))


def is_numbered(event, kind):
    return isinstance(event, kind) and isinstance(event.payload, dict) and "n" in event.payload


def test_quick_way_is_closed_to_long_messages_strangers_and_idle_agents():
    w = running()

    assert w.agents["agent-1"].seal_data(bytes(BEST_BYTES_MAX), w.now_s) is None
    assert w.host.seal_data("agent-1", bytes(BEST_BYTES_MAX), w.now_s) is None
    assert w.host.seal_data("nobody", 1, w.now_s) is None
    w.host.agent_exited("agent-1", "gone", w.now_s)
    assert w.host.seal_data("agent-1", 1, w.now_s) is None


@pytest.mark.parametrize("value", [{1, 2}, object(), [[{3: 4}]], 2**70])
def test_quick_way_refuses_what_messages_cannot_carry(value):
    w = running()

    with pytest.raises(UnencodableValue):
        w.agents["agent-1"].seal_data(value, w.now_s)


@pytest.mark.parametrize(
    "value", [None, True, -5, 2.5, "text", b"bytes", [1, [2, {"a": None}]], {"x": [1.5]}, (1, 2)]
)
def test_quick_way_carries_what_the_general_one_does(value):
    w = running()

    got = [take(w, w.agents["agent-1"].seal_data(value, w.now_s)) for _ in range(3)]

    assert got == [list(value) if isinstance(value, tuple) else value] * 3


def take(w, data):
    """Return what a datagram brings the host, by either way."""
    got = w.host.receive_data(data, ("agent-1",), w.now_s)
    return w.host.next_event().payload if got is None else got[1]


def test_quick_way_carries_arrays():
    w = running()
    array = np.arange(6.0).reshape(2, 3)

    payloads = [take(w, w.agents["agent-1"].seal_data({"r": array}, w.now_s)) for _ in range(3)]

    assert all(np.array_equal(payload["r"], array) for payload in payloads)


def test_run_by_the_quick_way_ends_like_any_other():
    w = running(count=3)
    while w.host.state is not HostState.EXIT and w.now_s < 130:
        w.send_tick()

    assert w.host.state is HostState.EXIT
    assert w.host_event(h.EmergencyDeclared) is None
