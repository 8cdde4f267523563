"""What a link promises, over wires that lose, repeat, reorder, change and delay datagrams."""

from __future__ import annotations

import itertools
import random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lossy_wire import Faults, LossyWire

from madns_runtime.protocol.datagram import PREFIX_BYTES, REST
from madns_runtime.protocol.link_settings import LinkLimits, SendQueueFull
from madns_runtime.protocol.messages import Service

STREAMS = (Service.RELIABLE, Service.SYNC)
BIT = {service: 1 << service for service in Service}

few = settings(
    derandomize=True,
    deadline=None,
    max_examples=80,
    suppress_health_check=[HealthCheck.too_slow],
)

FAULTS = st.builds(
    Faults,
    loss=st.floats(0, 0.2),
    duplication=st.floats(0, 0.2),
    corruption=st.floats(0, 0.1),
    delay_s=st.floats(0, 0.05),
    jitter_s=st.sampled_from([0.0, 0.001, 0.02, 0.1]),
)
SEEDS = st.integers(0, 2**32)


def contents_of(datagram):
    return REST.unpack_from(datagram, PREFIX_BYTES)[8]


def load(wire, seed, *, duration_s=1.0, large=30_000):
    """Queue a mix of messages of all classes, both ways; return what was sent by end and class."""
    chance = random.Random(seed)
    sent = {(e, s): [] for e in ("agent", "host") for s in Service}

    def send(name, service, size):
        log = sent[name, service]
        body = b"%d:" % len(log) + chance.randbytes(size)
        log.append(body)
        wire.send(getattr(wire, name), body, service)

    for _ in range(60):
        name = chance.choice(("agent", "host"))
        service = chance.choice(list(Service))
        size = chance.choice((0, 1, 30, 400, 1280))
        if service == Service.RELIABLE and chance.random() < 0.2:
            size = chance.randrange(large)
        t_s = wire.now_s + chance.random() * duration_s
        wire.at(t_s, lambda name=name, service=service, size=size: send(name, service, size))
    return sent


def peers(wire):
    return (("agent", wire.host), ("host", wire.agent))


@pytest.mark.slow
@given(SEEDS, FAULTS)
@few
def test_streams_arrive_exactly_once_and_in_order(seed, faults):
    wire = LossyWire(seed, faults)
    sent = load(wire, seed)

    wire.run_for(120.0)

    for sender, receiver in peers(wire):
        for service in STREAMS:
            assert sent[sender, service] == receiver.bodies(service)
    for end in (wire.agent, wire.host):
        assert end.link.is_flushed
        assert end.link.queued_bytes == 0
        assert end.link.held_bytes == 0
        assert end.link.get_timer() is None


@pytest.mark.slow
@given(SEEDS, FAULTS)
@few
def test_best_arrives_at_most_once_and_the_newest_wins(seed, faults):
    wire = LossyWire(seed, faults)
    sent = load(wire, seed)

    wire.run_for(120.0)

    for sender, receiver in peers(wire):
        log = sent[sender, Service.BEST]
        indices = [log.index(body) for body in receiver.bodies(Service.BEST)]
        assert sorted(set(indices)) == indices
        counters = receiver.link.counters.best
        assert len(indices) == counters.received
        # What is behind the newest one that came is not missed yet; all others are accounted for.
        newest = max(indices, default=-1)
        assert newest + 1 == counters.received + counters.lost + counters.late


@pytest.mark.slow
@given(SEEDS, st.sampled_from([0.0, 0.0003, 0.005, 0.02, 0.06, 0.1, 0.15, 0.2]))
@few
def test_nothing_is_sent_again_without_need_when_nothing_is_lost(seed, delay_s):
    wire = LossyWire(seed, Faults(delay_s=delay_s))
    load(wire, seed, duration_s=5.0)

    wire.run_for(60.0)

    for end in (wire.agent, wire.host):
        for counters in (end.link.counters.reliable, end.link.counters.sync):
            # Before the first round trip is known, one that is longer than 0.2 s is a surprise.
            assert counters.resent <= (2 if 2 * delay_s + 0.01 > 0.2 else 0)


@pytest.mark.slow
@given(SEEDS, FAULTS)
@few
def test_resends_stay_within_a_small_multiple_of_what_was_lost(seed, faults):
    wire = LossyWire(seed, faults)
    load(wire, seed)

    wire.run_for(120.0)

    total = len(wire.carried)
    wire = LossyWire(seed)
    load(wire, seed)
    wire.run_for(120.0)
    assert total < 4 * len(wire.carried) + 40


@pytest.mark.slow
@given(SEEDS, FAULTS, st.integers(0, 40_000))
@few
def test_memory_for_unfinished_messages_is_bounded_by_the_window(seed, faults, window_bytes):
    limits = LinkLimits(receive_window_bytes=window_bytes)
    reliable, sync = limits.get_windows()
    wire = LossyWire(seed, faults, limits=limits)
    largest = 30_000
    sent = load(wire, seed, large=largest)

    wire.run_for(300.0)

    for sender, receiver in peers(wire):
        assert sent[sender, Service.RELIABLE] == receiver.bodies(Service.RELIABLE)
        assert receiver.held_bytes_max <= (reliable + sync) * 1400 + largest + 1400


@pytest.mark.slow
@given(SEEDS, st.floats(0, 0.2))
@few
def test_receiver_that_does_not_read_stops_the_sender_and_then_gets_all(seed, loss):
    limits = LinkLimits(receive_window_bytes=20_000, send_queue_bytes_max=100_000)
    wire = LossyWire(seed, Faults(loss=loss), limits=limits)
    wire.host.is_reading = False
    sent = {service: [] for service in STREAMS}

    for service in STREAMS:
        with pytest.raises(SendQueueFull):
            for i in itertools.count():
                body = b"%d:" % i + bytes(700)
                wire.send(wire.agent, body, service)
                sent[service].append(body)
    before = len(wire.carried)
    wire.run_for(30.0)

    assert wire.host.received == []
    ready = 1 + limits.receive_window_bytes // 1400
    assert wire.host.link.counters.reliable.received <= 2 * ready
    assert wire.host.link.counters.sync.received <= 2 * ready
    assert len(wire.carried) - before < 350  # the window, resends, and probes that slow down
    assert wire.agent.link.counters.send_queue_full == 2

    wire.host.is_reading = True
    wire.run_for(60.0)

    for service in STREAMS:
        assert sent[service] == wire.host.bodies(service)
    assert wire.agent.link.is_flushed


@pytest.mark.parametrize("socket_max", [0, 5, 1000])
@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_frozen_receiver_recovers_when_thawed(socket_max, loss):
    wire = LossyWire(11, Faults(loss=loss))
    wire.host.socket_max = socket_max
    sent = {service: [] for service in STREAMS}

    def tick(i):
        for service in STREAMS:
            sent[service].append(b"%d:" % i + bytes(300))
            wire.send(wire.agent, sent[service][-1], service)
        wire.send(wire.agent, b"%d" % i, Service.BEST)

    def set_frozen(value):
        wire.host.is_frozen = value
        wire.host.socket_max = socket_max if value else 10_000

    for i in range(800):
        wire.at(wire.now_s + 0.01 * i, lambda i=i: tick(i))
    wire.at(wire.now_s + 1.0, lambda: set_frozen(True))
    wire.at(wire.now_s + 6.0, lambda: set_frozen(False))
    wire.run_for(5.9)
    resent_while_frozen = wire.agent.link.counters.reliable.resent
    thawed_s = wire.now_s + 0.1
    wire.run_for(60.0)

    for service in STREAMS:
        assert sent[service] == wire.host.bodies(service)
    assert resent_while_frozen < 30
    # Within a second or two after the thaw the backlog has been worked off.
    backlog = [t for t in wire.host.arrivals(Service.RELIABLE) if t >= thawed_s]
    assert backlog[350] < thawed_s + 2.0
    assert wire.agent.link.is_flushed


def run_ticks(drop):
    """Send all three classes, each in datagrams of its own, and return when each message arrived."""
    wire = LossyWire(5, drop=drop)
    start_s = wire.now_s
    for i in range(200):
        at_s = start_s + 0.01 * i
        wire.at(at_s, lambda: wire.send(wire.agent, b"maneuver", Service.SYNC))
        wire.at(at_s + 0.003, lambda: wire.send(wire.agent, b"tick", Service.BEST))
        wire.at(at_s + 0.006, lambda: wire.send(wire.agent, bytes(2000), Service.RELIABLE))
    wire.run_for(30.0)
    return {s: [round(t - start_s, 6) for t in wire.host.arrivals(s)] for s in Service}


@pytest.mark.parametrize("lost", list(Service))
def test_loss_in_one_class_delays_no_other(lost):
    chance = random.Random(9)
    undisturbed = run_ticks(None)

    disturbed = run_ticks(
        lambda datagram, t_s: contents_of(datagram) == BIT[lost] and chance.random() < 0.3
    )

    assert disturbed[lost] != undisturbed[lost]
    for service in set(Service) - {lost}:
        assert disturbed[service] == undisturbed[service]


@pytest.mark.parametrize("lost", STREAMS)
def test_total_loss_of_a_stream_leaves_the_others_alone(lost):
    """As on a path that takes no large datagrams."""
    undisturbed = run_ticks(None)

    disturbed = run_ticks(lambda datagram, t_s: bool(contents_of(datagram) & BIT[lost]))

    assert disturbed[lost] == []
    for service in set(Service) - {lost}:
        # A BEST message that rode with the stream is lost with it, but none is late.
        assert set(disturbed[service]) <= set(undisturbed[service])
        assert len(disturbed[service]) > 180


def test_stream_that_never_gets_through_slows_down():
    wire = LossyWire(5, drop=lambda datagram, t_s: bool(contents_of(datagram) & 2))
    for i in range(1000):
        wire.at(wire.now_s + 0.01 * i, lambda: wire.send(wire.agent, b"maneuver", Service.SYNC))
    for _ in range(100):
        wire.send(wire.agent, bytes(1200), Service.RELIABLE)

    wire.run_for(10.0)

    counters = wire.agent.link.counters.reliable
    window = LinkLimits().get_windows()[0]
    assert counters.resent < 20 * window


def test_ticks_keep_their_pace_beside_a_large_transfer():
    wire = LossyWire(6, Faults(delay_s=0.0003))
    start_s = wire.now_s
    wire.send(wire.host, bytes(2_000_000), Service.RELIABLE)
    for i in range(100):
        wire.at(start_s + 0.01 * i, lambda: wire.send(wire.host, b"tick", Service.BEST))

    wire.run_for(30.0)

    expected = [round(start_s + 0.01 * i + 0.0003, 6) for i in range(100)]
    assert expected == [round(t, 6) for t in wire.agent.arrivals(Service.BEST)]
    assert len(wire.agent.bodies(Service.RELIABLE)) == 1


@pytest.mark.parametrize("pace_bytes_per_s", [1e5, 1e6, 8e6])
def test_fragments_keep_to_their_pace(pace_bytes_per_s):
    limits = LinkLimits(pace_bytes_per_s=pace_bytes_per_s, receive_window_bytes=1_000_000)
    wire = LossyWire(6, Faults(delay_s=0.0003), limits=limits)
    start_s = wire.now_s
    size = 300_000

    wire.send(wire.host, bytes(size), Service.RELIABLE)
    wire.run_for(30.0)

    took_s = wire.agent.arrivals(Service.RELIABLE)[0] - start_s
    ideal_s = (size - limits.pace_burst_bytes) / pace_bytes_per_s
    assert ideal_s < took_s < ideal_s * 1.05 + 0.01
    # A wake-up sends what a millisecond allows, not one datagram.
    sent_at = {t_s for t_s, up, _ in wire.carried if not up}
    acknowledged_at = {t_s for t_s, up, _ in wire.carried if up}
    assert len(sent_at) <= took_s / 0.001 + len(acknowledged_at) + 2


def test_lost_window_update_does_not_stop_a_stream_for_ever():
    """The receiver reads at last, but the datagram that says so is lost."""
    limits = LinkLimits(receive_window_bytes=0)
    wire = LossyWire(8, limits=limits)
    wire.host.is_reading = False
    bodies = [b"%d:" % i + bytes(1200) for i in range(30)]
    for body in bodies:
        wire.send(wire.agent, body, Service.RELIABLE)
    wire.run_for(5.0)
    assert len(wire.host.received) == 0

    lost_until_s = wire.now_s + 3.0
    wire.drop = lambda datagram, t_s: t_s < lost_until_s
    wire.host.is_reading = True
    wire.run_for(60.0)

    assert bodies == wire.host.bodies(Service.RELIABLE)


def test_silent_peer_costs_a_bounded_trickle():
    wire = LossyWire(4, drop=lambda datagram, t_s: True)
    for _ in range(100):
        wire.send(wire.agent, bytes(1000), Service.RELIABLE)
        wire.send(wire.agent, bytes(1000), Service.SYNC)

    wire.run_for(600.0)

    # Both streams' first windows, then one datagram per second for each.
    assert 1000 < len(wire.carried) < 1300
    assert not wire.agent.link.is_flushed
