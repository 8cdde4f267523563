"""Datagrams that are not the peer's, or not what a peer may send: they change nothing but counters."""

from __future__ import annotations

import random
from collections import deque

import pytest
from harness.host_links import host_link
from lossy_wire import RUN_KEY, SESSION, LossyWire

from madns_runtime.protocol.counters import ClassCounters, LinkCounters
from madns_runtime.protocol.datagram import DATAGRAM_BYTES_MAX, FRAME, REST, Role, Seal, derive_keys
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.messages import Service

FUZZED_COUNT = 10_000


def snapshot(value):
    """Return everything that an object holds, except counters and keys, as comparable values."""
    if isinstance(value, LinkCounters | ClassCounters | Seal):
        return None
    if isinstance(value, dict):
        return [(k, snapshot(v)) for k, v in value.items()]
    if isinstance(value, list | tuple | deque):
        return [snapshot(v) for v in value]
    names = getattr(type(value), "__slots__", None)
    if names is not None and not isinstance(value, int | str):
        return [(name, snapshot(getattr(value, name))) for name in names]
    return value.hex() if isinstance(value, bytearray) else value


def busy_wire():
    """Return a wire in mid-conversation, with messages of all kinds on their way and half received."""
    wire = LossyWire(3, drop=lambda datagram, t_s: wire.random.random() < 0.2)
    for i in range(60):
        for end in (wire.agent, wire.host):
            for service, size in ((Service.BEST, 30), (Service.RELIABLE, 3000), (Service.SYNC, 30)):
                wire.at(
                    wire.now_s + 0.005 * i,
                    lambda e=end, s=service, n=size: wire.send(e, bytes(n), s),
                )
    wire.run_for(0.15)
    return wire


def hostile_datagrams(wire, count):
    """Yield what anybody on the network may send to the host, who has seen all that was said."""
    chance = random.Random(4)
    seen = [data for _, _, data in wire.carried]
    arrived = [data for _, up, data in wire.carried if up]
    strangers = [
        Link.for_agent(bytes(32), SESSION, 7, 99),
        Link.for_agent(RUN_KEY, b"session2", 7, 99),
        Link.for_agent(RUN_KEY, SESSION, 8, 99),
        Link.for_agent(RUN_KEY, SESSION, 7, 98),
        host_link(RUN_KEY, SESSION, 7, 99),
    ]

    def change(data):
        changed = bytearray(data)
        for _ in range(chance.choice((1, 1, 2, 8))):
            changed[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        return bytes(changed)

    def seal_as_stranger():
        link = chance.choice(strangers)
        link.send(chance.randbytes(chance.randrange(200)), chance.choice(list(Service)), 1.0)
        link.abandon() if chance.random() < 0.01 else None
        return chance.choice(link.datagrams_to_send(1.0) or [b""])

    def cut(data):
        return data[: chance.randrange(len(data))]

    makers = (
        lambda: chance.randbytes(chance.randrange(DATAGRAM_BYTES_MAX + 1)),
        lambda: chance.randbytes(chance.randrange(DATAGRAM_BYTES_MAX + 1, 65_508)),
        lambda: cut(chance.choice(seen)),
        lambda: change(chance.choice(seen)),
        lambda: chance.choice(arrived)[:16] + chance.randbytes(chance.randrange(1300)),
        lambda: chance.choice(arrived) + chance.randbytes(chance.randrange(1, 1400)),
        lambda: chance.choice(arrived),
        seal_as_stranger,
    )
    for i in range(count):
        yield makers[i % len(makers)]()


def test_ten_thousand_hostile_datagrams_change_nothing_but_counters():
    wire = busy_wire()
    host = wire.host.link
    # What the wire lost was never received: as a replay it would be the real thing.
    for _, up, data in list(wire.carried):
        if up:
            host.receive_datagram(data, wire.now_s)
    while host.next_message() is not None:
        pass
    host.datagrams_to_send(wire.now_s)
    before = snapshot(host)
    refused_before = sum(host.counters.refused.values())
    counted_before = host.counters.to_mapping()

    outcomes = {
        host.receive_datagram(data, wire.now_s) for data in hostile_datagrams(wire, FUZZED_COUNT)
    }

    assert {False} == outcomes
    host.was_forged = False  # of the last one, which is told beside the counters
    assert before == snapshot(host)
    counted = host.counters.to_mapping()
    assert sum(counted.pop("refused").values()) - refused_before == FUZZED_COUNT
    counted_before.pop("refused")
    assert counted_before == counted
    for reason in ("short", "oversize", "version", "sender", "mac", "replay"):
        assert host.counters.refused[reason] > 0
    assert host.next_message() is None


def test_conversation_goes_on_amid_hostile_datagrams():
    wire = LossyWire(5)
    sent = [b"%d:" % i + bytes(500) for i in range(100)]
    for i, body in enumerate(sent):
        wire.at(wire.now_s + 0.01 * i, lambda b=body: wire.send(wire.agent, b, Service.RELIABLE))
    wire.run_for(0.1)

    for data in list(hostile_datagrams(wire, 800)):
        wire.at(wire.now_s + 0.001, lambda d=data: wire.host.socket.append(d))
        wire.run_for(0.001)
    wire.run_for(10.0)

    assert sent == wire.host.bodies(Service.RELIABLE)
    assert sum(wire.host.link.counters.refused.values()) == 800


def make_host_and_forge():
    """Return a host's link, and a way to seal what no honest agent would send."""
    seal = Seal(
        derive_keys(RUN_KEY, SESSION, 7, 99),
        Role.AGENT,
        session=SESSION,
        agent_index=7,
        incarnation_id=99,
    )

    def forge(payload=b"", **fields):
        values = {
            "packet_number": 1,
            "ack": 0,
            "ack_bits": 0,
            "reliable_next": 0,
            "sync_next": 0,
            "reliable_granted": 4,
            "sync_granted": 4,
            "ack_delay": 0,
            "contents": 0,
            "zero": 0,
        }
        assert set(fields) <= set(values)
        return seal.close(REST.pack(*(values | fields).values()), payload)

    return host_link(RUN_KEY, SESSION, 7, 99), forge


def frame(kind=Service.BEST, number=0, body=b"body", length=None):
    return FRAME.pack(kind, 0, len(body) if length is None else length, number) + body


@pytest.mark.parametrize(
    "payload",
    [
        b"\x00",
        frame()[:11],
        frame(length=5),
        frame(length=65_535),
        frame(kind=3),
        frame(kind=255),
        frame() + b"\x00",
        frame() + frame(length=9),
        frame(Service.RELIABLE, number=35),
        frame(Service.SYNC, number=11),
        frame(Service.RELIABLE, number=2**64 - 1),
    ],
    ids=range(11),
)
def test_malformed_frames_of_a_peer_are_refused_whole(payload):
    host, forge = make_host_and_forge()
    before = snapshot(host)

    assert not host.receive_datagram(forge(payload), float("-inf"))

    assert host.counters.refused["malformed"] == 1
    assert before == snapshot(host)
    assert host.next_message() is None


@pytest.mark.parametrize(
    "fields",
    [
        {"ack": 1},
        {"ack": 2**64 - 1},
        {"reliable_next": 1},
        {"sync_next": 2**64 - 1},
    ],
    ids=lambda fields: next(iter(fields)),
)
def test_acknowledgement_of_what_was_never_sent_is_refused(fields):
    host, forge = make_host_and_forge()

    assert not host.receive_datagram(forge(**fields), 1.0)

    assert host.counters.refused["malformed"] == 1


def test_packet_number_zero_is_refused():
    host, forge = make_host_and_forge()

    assert not host.receive_datagram(forge(packet_number=0), 1.0)

    assert host.counters.refused["replay"] == 1


def test_largest_numbers_of_a_peer_are_taken():
    host, forge = make_host_and_forge()
    largest = 2**64 - 1

    assert host.receive_datagram(
        forge(
            frame(number=largest),
            packet_number=largest,
            ack_bits=largest,
            reliable_granted=65_535,
            ack_delay=65_535,
            contents=255,
            zero=255,
        ),
        1.0,
    )

    assert host.next_message().body == b"body"
    assert len(host.datagrams_to_send(1.0)) == 1


def test_repeated_best_message_in_another_packet_is_a_duplicate():
    host, forge = make_host_and_forge()
    for packet_number in (1, 2):
        host.receive_datagram(forge(frame(), packet_number=packet_number), 1.0)

    assert host.counters.best.duplicates == 1
    assert host.counters.best.received == 1


def test_fragments_of_one_byte_make_a_message():
    host, forge = make_host_and_forge()
    stream = bytes((5, 0, 0, 9)) + b"hello" + bytes((0, 0, 0, 0)) + bytes((1, 0, 0, 8)) + b"x"
    for i in range(len(stream)):
        piece = frame(Service.RELIABLE, number=i, body=stream[i : i + 1])
        assert host.receive_datagram(forge(piece, packet_number=i + 1, contents=2), 1.0)

    messages = [host.next_message() for _ in range(3)]

    assert [(m.channel, m.body) for m in messages] == [(9, b"hello"), (0, b""), (8, b"x")]
    assert host.held_bytes == 0
