"""Keys, headers and MACs: what one end sealed opens at the other end, and nothing else does."""

from __future__ import annotations

import itertools

import pytest

from madns_runtime.protocol.datagram import (
    DATAGRAM_BYTES_MAX,
    OVERHEAD_BYTES,
    PAYLOAD_BYTES_MAX,
    REST,
    Header,
    Role,
    Seal,
    derive_keys,
)
from madns_runtime.protocol.messages import VERSION
from madns_runtime.protocol.packets import REPLAY_WINDOW_PACKETS, Packets

RUN_KEY = bytes(range(32))
SESSION = b"12345678"


def make_seal(role, *, run_key=RUN_KEY, session=SESSION, agent_index=3, incarnation=5):
    keys = derive_keys(run_key, session, agent_index, incarnation)
    return Seal(keys, role, session=session, agent_index=agent_index, incarnation_id=incarnation)


def close(seal, payload=b"frames", packet_number=1):
    return seal.close(REST.pack(packet_number, 0, 0, 0, 0, 4, 4, 0, 0, 0), payload)


def test_every_agent_session_incarnation_and_direction_has_its_own_key():
    keys = [
        derive_keys(run_key, session, agent_index, incarnation)
        for run_key, session, agent_index, incarnation in itertools.product(
            (RUN_KEY, bytes(32)), (SESSION, b"87654321"), (1, 2, 65_535), (0, 1, 2**32 - 1)
        )
    ]
    distinct = {key for pair in keys for key in (pair.up, pair.down)}

    assert 2 * len(keys) == len(distinct)
    assert {32} == {len(key) for key in distinct}


def test_keys_are_the_same_on_both_sides():
    assert derive_keys(RUN_KEY, SESSION, 3, 5) == derive_keys(RUN_KEY, SESSION, 3, 5)


def test_representation_shows_no_key():
    keys = derive_keys(RUN_KEY, SESSION, 3, 5)

    assert repr(keys) == "LinkKeys(...)"
    assert str(keys) == "LinkKeys(...)"


@pytest.mark.parametrize(
    ("run_key", "session", "agent_index", "incarnation"),
    [
        (bytes(31), SESSION, 1, 0),
        (bytes(65), SESSION, 1, 0),
        (RUN_KEY, b"short", 1, 0),
        (RUN_KEY, SESSION, 0, 0),
        (RUN_KEY, SESSION, 65_536, 0),
        (RUN_KEY, SESSION, 1, -1),
        (RUN_KEY, SESSION, 1, 2**32),
    ],
)
def test_keys_are_derived_from_sound_arguments_only(run_key, session, agent_index, incarnation):
    with pytest.raises(ValueError, match="expected"):
        derive_keys(run_key, session, agent_index, incarnation)


def test_header_is_seen_without_a_key():
    datagram = close(make_seal(Role.AGENT), packet_number=77)

    expected = Header(
        version=VERSION,
        role=Role.AGENT,
        agent_index=3,
        incarnation_id=5,
        session=SESSION,
        packet_number=77,
    )
    assert expected == Header.peek(datagram)


@pytest.mark.parametrize("size", [0, 1, OVERHEAD_BYTES - 1, DATAGRAM_BYTES_MAX + 1])
def test_no_header_in_what_cannot_be_a_datagram(size):
    assert Header.peek(bytes(size)) is None


def test_peer_finds_no_fault_in_a_sealed_datagram():
    agent, host = make_seal(Role.AGENT), make_seal(Role.HOST)

    for payload in (b"", b"x", bytes(PAYLOAD_BYTES_MAX)):
        assert host.find_fault(close(agent, payload)) is None
        assert agent.find_fault(close(host, payload)) is None


def test_largest_datagram_fits_the_bound():
    assert len(close(make_seal(Role.HOST), bytes(PAYLOAD_BYTES_MAX))) == DATAGRAM_BYTES_MAX


def test_every_changed_bit_is_a_fault():
    agent, host = make_seal(Role.AGENT), make_seal(Role.HOST)
    datagram = close(agent)

    for position in range(8 * len(datagram)):
        changed = bytearray(datagram)
        changed[position // 8] ^= 1 << position % 8
        assert host.find_fault(bytes(changed)) in {"version", "sender", "mac"}


@pytest.mark.parametrize(
    ("sender", "fault"),
    [
        (make_seal(Role.HOST), "sender"),
        (make_seal(Role.AGENT, agent_index=4), "sender"),
        (make_seal(Role.AGENT, incarnation=6), "sender"),
        (make_seal(Role.AGENT, session=b"87654321"), "sender"),
        (make_seal(Role.AGENT, run_key=bytes(32)), "mac"),
    ],
    ids=["reflected", "agent", "incarnation", "session", "key"],
)
def test_datagram_of_another_conversation_is_a_fault(sender, fault):
    assert fault == make_seal(Role.HOST).find_fault(close(sender))


def test_datagram_of_another_conversation_fails_under_our_prefix_too():
    """The keys separate the conversations, not only the names in the header."""
    host = make_seal(Role.HOST)
    for other in (
        make_seal(Role.HOST),
        make_seal(Role.AGENT, agent_index=4),
        make_seal(Role.AGENT, incarnation=6),
        make_seal(Role.AGENT, session=b"87654321"),
    ):
        other.prefix = host.peer_prefix

        assert host.find_fault(close(other)) == "mac"


@pytest.mark.parametrize(
    ("datagram", "fault"),
    [
        (b"", "short"),
        (bytes(OVERHEAD_BYTES - 1), "short"),
        (bytes(DATAGRAM_BYTES_MAX + 1), "oversize"),
        (bytes(200), "version"),
    ],
)
def test_what_is_no_datagram_is_a_fault(datagram, fault):
    assert fault == make_seal(Role.HOST).find_fault(datagram)


def test_cut_datagram_is_a_fault():
    host, datagram = make_seal(Role.HOST), close(make_seal(Role.AGENT), bytes(100))

    assert {"short", "mac"} == {host.find_fault(datagram[:size]) for size in range(len(datagram))}


def test_packet_is_new_once():
    packets = Packets()

    for number in (5, 3, 9, 4, 1, 2000, 1999):
        assert packets.is_new(number)
        packets.add(number, 0.0)
        assert not packets.is_new(number)


def test_packet_older_than_the_window_is_refused():
    packets = Packets()
    packets.add(5000, 0.0)

    assert packets.is_new(5000 - REPLAY_WINDOW_PACKETS + 1)
    assert not packets.is_new(5000 - REPLAY_WINDOW_PACKETS)
    assert not packets.is_new(0)


def test_packet_number_zero_is_never_new():
    assert not Packets().is_new(0)


def test_far_jump_keeps_the_bitmap_small():
    packets = Packets()
    packets.add(1, 0.0)

    assert not packets.add(2**64 - 1, 0.0)

    assert packets.largest == 2**64 - 1
    assert packets.ack_bits == 0
    assert packets.is_new(2**64 - 2)


def test_bitmap_names_the_packets_before_the_largest():
    packets = Packets()

    in_order = [packets.add(number, 0.0) for number in (1, 2, 4, 3, 70)]

    assert in_order == [True, True, False, False, False]
    # 70 is the largest; bit i stands for 69 - i, and 64 bits reach down to 6.
    assert packets.ack_bits == 0
    packets.add(69, 0.0)
    packets.add(6, 0.0)
    assert packets.ack_bits == 1 | 1 << 63
