"""What one link does, call by call."""

from __future__ import annotations

import pytest
from harness.host_links import host_link
from lossy_wire import RUN_KEY, SESSION, Faults, LossyWire

from madns_runtime.errors import MadnsError, MessageTooLarge
from madns_runtime.protocol import sending
from madns_runtime.protocol.datagram import (
    BEST_BYTES_MAX,
    DATAGRAM_BYTES_MAX,
    FRAME,
    FRAME_BYTES,
    HEADER_BYTES,
    MAC_BYTES,
    MESSAGE_BYTES_MAX,
    OVERHEAD_BYTES,
    Header,
)
from madns_runtime.protocol.deadlines import BROKEN_UNREAD_MAX, BrokenDeadline
from madns_runtime.protocol.incoming import Received
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import LinkLimits, SendQueueFull
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.packets import ACK_DELAY_MAX_S, RoundTrip, TokenBucket

BEST, RELIABLE, SYNC = Service


def make_pair(**limits):
    options = {"limits": LinkLimits(**limits)} if limits else {}
    return (
        Link.for_agent(RUN_KEY, SESSION, 1, 2, **options),
        host_link(RUN_KEY, SESSION, 1, 2, **options),
    )


def deliver(datagrams, link, now_s):
    return [link.receive_datagram(data, now_s) for data in datagrams]


def read(link):
    messages = []
    while (message := link.next_message()) is not None:
        messages.append(message)
    return messages


def frames_in(datagram):
    """Return (service, number) of the frames of a datagram."""
    frames, offset = [], HEADER_BYTES
    while offset < len(datagram) - MAC_BYTES:
        kind, _, length, number = FRAME.unpack_from(datagram, offset)
        frames.append((kind, number))
        offset += FRAME_BYTES + length
    return frames


@pytest.mark.parametrize("service", Service)
@pytest.mark.parametrize("body", [b"", b"x", bytes(30), bytes(BEST_BYTES_MAX)])
def test_message_arrives_as_sent(service, body):
    agent, host = make_pair()

    agent.send(body, service, 1.0, channel=255)
    datagrams = agent.datagrams_to_send(1.0)

    assert all(deliver(datagrams, host, 1.001))
    assert [Received(service, 255, body)] == read(host)
    assert host.next_message() is None


def test_both_sides_send_and_receive():
    agent, host = make_pair()

    host.send(b"down", RELIABLE, 1.0)
    deliver(host.datagrams_to_send(1.0), agent, 1.0)

    assert [m.body for m in read(agent)] == [b"down"]


def test_new_link_has_nothing_to_do():
    agent, _ = make_pair()

    assert agent.get_timer() is None
    assert agent.datagrams_to_send(1.0) == []
    assert agent.next_message() is None
    assert agent.next_broken_deadline() is None
    assert agent.srtt_s is None
    assert agent.is_flushed
    assert agent.queued_bytes == 0


def test_datagrams_of_a_peer_start_with_its_prefix():
    agent, host = make_pair()
    agent.send(b"x", BEST, 1.0)
    (datagram,) = agent.datagrams_to_send(1.0)

    assert datagram.startswith(host.peer_prefix)
    assert Header.peek(datagram).agent_index == 1
    assert Header.peek(datagram).incarnation_id == 2


def test_best_must_fit_one_datagram():
    agent, _ = make_pair()

    with pytest.raises(MessageTooLarge, match="send it RELIABLE"):
        agent.send(bytes(BEST_BYTES_MAX + 1), BEST, 1.0)
    agent.send(bytes(BEST_BYTES_MAX), BEST, 1.0)

    assert len(agent.datagrams_to_send(1.0)[0]) == DATAGRAM_BYTES_MAX


@pytest.mark.parametrize("service", [RELIABLE, SYNC])
def test_stream_message_has_a_largest_size(service):
    agent, _ = make_pair()

    with pytest.raises(MessageTooLarge, match="16777215"):
        agent.send(bytes(MESSAGE_BYTES_MAX + 1), service, 1.0)
    assert agent.is_flushed


def test_message_larger_than_the_queue_is_too_large():
    agent, _ = make_pair(send_queue_bytes_max=1000)

    with pytest.raises(MessageTooLarge, match="1000"):
        agent.send(bytes(1001), RELIABLE, 1.0)


def test_largest_message_arrives():
    limits = LinkLimits(receive_window_bytes=1_000_000, pace_bytes_per_s=1e9)
    wire = LossyWire(1, limits=limits)
    body = bytes(range(256)) * 65_535

    wire.send(wire.agent, body, RELIABLE)
    wire.run_for(60.0)

    assert [body] == wire.host.bodies(RELIABLE)


@pytest.mark.parametrize("channel", [-1, 256])
def test_channel_out_of_bounds_is_an_error(channel):
    agent, _ = make_pair()

    with pytest.raises(ValueError, match="channel"):
        agent.send(b"", BEST, 1.0, channel=channel)


def test_full_send_queue_is_an_error_and_counted():
    agent, _ = make_pair(send_queue_bytes_max=1000)
    agent.send(bytes(900), RELIABLE, 1.0)

    with pytest.raises(SendQueueFull, match="904 bytes wait") as caught:
        agent.send(bytes(200), RELIABLE, 1.0)

    assert isinstance(caught.value, MadnsError)
    assert agent.counters.send_queue_full == 1
    assert agent.counters.reliable.sent == 1
    agent.send(bytes(200), SYNC, 1.0)  # the other stream has a queue of its own


def test_many_short_messages_fill_the_queue_too(monkeypatch):
    monkeypatch.setattr(sending, "MESSAGES_QUEUED_MAX", 3)
    agent, _ = make_pair()
    for _ in range(3):
        agent.send(b"", RELIABLE, 1.0)

    with pytest.raises(SendQueueFull):
        agent.send(b"", RELIABLE, 1.0)


def test_best_queue_keeps_the_newest():
    agent, host = make_pair(best_queue_max=2)
    for body in (b"1", b"2", b"3"):
        agent.send(body, BEST, 1.0)

    deliver(agent.datagrams_to_send(1.0), host, 1.0)

    assert [m.body for m in read(host)] == [b"2", b"3"]
    assert agent.counters.best.dropped == 1
    assert host.counters.best.lost == 1


def test_best_messages_that_nobody_reads_make_way_for_newer():
    agent, host = make_pair(best_queue_max=2)
    for body in (b"1", b"2", b"3"):
        agent.send(body, BEST, 1.0)
        deliver(agent.datagrams_to_send(1.0), host, 1.0)

    assert [m.body for m in read(host)] == [b"2", b"3"]
    assert host.counters.best.dropped == 1


def test_late_best_message_is_late_and_not_lost():
    agent, host = make_pair()
    datagrams = []
    for body in (b"0", b"1", b"2", b"3"):
        agent.send(body, BEST, 1.0)
        datagrams += agent.datagrams_to_send(1.0)

    deliver([datagrams[0], datagrams[3]], host, 1.0)
    assert host.counters.best.lost == 2
    deliver([datagrams[1]], host, 1.1)

    assert [m.body for m in read(host)] == [b"0", b"3"]
    assert (
        host.counters.best.lost,
        host.counters.best.late,
        host.counters.best.received,
    ) == (1, 1, 2)


def test_best_channels_do_not_overtake_each_other():
    agent, host = make_pair()
    datagrams = []
    for channel in (1, 2):
        agent.send(b"%d" % channel, BEST, 1.0, channel=channel)
        datagrams += agent.datagrams_to_send(1.0)

    deliver(reversed(datagrams), host, 1.0)

    assert [m.channel for m in read(host)] == [2, 1]
    assert host.counters.best.late + host.counters.best.lost == 0


def test_sync_goes_before_best_and_best_before_fragments():
    agent, _ = make_pair()
    agent.send(bytes(3000), RELIABLE, 1.0)
    agent.send(b"tick", BEST, 1.0)
    agent.send(b"maneuver", SYNC, 1.0)

    frames = [frames_in(d) for d in agent.datagrams_to_send(1.0)]

    assert frames == [[(SYNC, 0), (BEST, 0)], [(RELIABLE, 0)], [(RELIABLE, 1)], [(RELIABLE, 2)]]


def test_small_messages_share_a_fragment_and_a_datagram():
    agent, host = make_pair()
    for i in range(20):
        agent.send(b"%d" % i, RELIABLE, 1.0)
    agent.send(b"tick", BEST, 1.0)

    (datagram,) = agent.datagrams_to_send(1.0)

    assert frames_in(datagram) == [(BEST, 0), (RELIABLE, 0)]
    deliver([datagram], host, 1.0)
    assert [b"%d" % i for i in range(20)] == [m.body for m in read(host) if m.service == RELIABLE]


def test_best_messages_spread_over_datagrams_when_they_must():
    agent, host = make_pair()
    for _ in range(5):
        agent.send(bytes(500), BEST, 1.0)

    datagrams = agent.datagrams_to_send(1.0)

    assert [len(frames_in(d)) for d in datagrams] == [2, 2, 1]
    deliver(datagrams, host, 1.0)
    assert len(read(host)) == 5


def test_best_and_ack_alone_are_not_acknowledged():
    agent, host = make_pair()
    agent.send(b"tick", BEST, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)

    assert host.get_timer() is None
    assert host.datagrams_to_send(2.0) == []


def test_lone_reliable_message_is_acknowledged_after_a_short_delay():
    agent, host = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)

    due_s = host.get_timer()
    assert 1.005 < due_s <= 1.025
    assert host.datagrams_to_send(1.004) == []
    host.handle_timer(due_s)
    (ack,) = host.datagrams_to_send(due_s)

    assert len(ack) == OVERHEAD_BYTES
    assert not agent.is_flushed
    deliver([ack], agent, due_s)
    assert agent.is_flushed
    assert agent.counters.reliable.acknowledged == 1
    assert agent.get_timer() is None
    assert host.get_timer() is None


def test_second_reliable_packet_is_acknowledged_at_once():
    agent, host = make_pair()
    for _ in range(2):
        agent.send(b"x", RELIABLE, 1.0)
        deliver(agent.datagrams_to_send(1.0), host, 1.0)

    assert len(host.datagrams_to_send(1.0)) == 1


def test_sync_is_acknowledged_at_once():
    agent, host = make_pair()
    agent.send(b"x", SYNC, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)

    assert len(host.datagrams_to_send(1.0)) == 1


def test_acknowledgement_that_is_due_is_not_put_off():
    agent, host = make_pair()
    datagrams = []
    for service in (SYNC, RELIABLE):
        agent.send(b"x", service, 1.0)
        datagrams += agent.datagrams_to_send(1.0)

    deliver(datagrams[:1], host, 1.0)
    deliver(datagrams[1:], host, 1.005)

    assert host.get_timer() <= 1.005


def test_packet_after_a_gap_is_acknowledged_at_once():
    agent, host = make_pair()
    for _ in range(2):
        agent.send(b"x", RELIABLE, 1.0)
        datagrams = agent.datagrams_to_send(1.0)
    deliver(datagrams, host, 1.0)

    assert len(host.datagrams_to_send(1.0)) == 1


def test_acknowledgement_rides_with_whatever_is_sent():
    agent, host = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)
    host.send(b"tick", BEST, 1.001)

    deliver(host.datagrams_to_send(1.001), agent, 1.001)

    assert agent.is_flushed
    assert host.get_timer() is None


def test_first_resend_waits_a_tenth_of_a_second_at_least():
    agent, _ = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    agent.datagrams_to_send(1.0)

    due_s = agent.get_timer()
    assert 1.1 <= due_s <= 1.3
    agent.handle_timer(1.099)
    assert agent.datagrams_to_send(1.099) == []
    agent.handle_timer(due_s)
    (again,) = agent.datagrams_to_send(due_s)

    assert frames_in(again) == [(RELIABLE, 0)]
    assert Header.peek(again).packet_number == 2
    assert agent.counters.reliable.resent == 1


def test_resends_back_off_to_a_bound():
    agent, _ = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    agent.datagrams_to_send(1.0)

    times = []
    for _ in range(100):
        times.append(agent.get_timer())
        agent.handle_timer(times[-1])
        assert len(agent.datagrams_to_send(times[-1])) == 1

    gaps = [b - a for a, b in zip(times, times[1:], strict=False)]
    assert sorted(gaps[:3]) == gaps[:3]
    assert 0.99 < gaps[-1] < 1.01


def learn_round_trip(agent, host, *, now_s, delay_s=0.001):
    agent.send(b"tick", SYNC, now_s)
    deliver(agent.datagrams_to_send(now_s), host, now_s + delay_s)
    deliver(host.datagrams_to_send(now_s + delay_s), agent, now_s + 2 * delay_s)
    read(host)


def test_resend_follows_the_round_trip_once_it_is_known():
    agent, host = make_pair()
    for i in range(10):
        learn_round_trip(agent, host, now_s=1.0 + i)
    agent.send(b"x", RELIABLE, 20.0)
    agent.datagrams_to_send(20.0)

    assert 20.02 <= agent.get_timer() <= 20.055


def test_round_trip_leaves_out_what_the_peer_waited():
    agent, host = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.003)
    acknowledged_s = host.get_timer()
    deliver(host.datagrams_to_send(acknowledged_s), agent, acknowledged_s + 0.003)

    assert agent.srtt_s == pytest.approx(0.006, abs=2e-5)


def test_acknowledgement_after_an_unknown_delay_gives_no_round_trip():
    agent, host = make_pair()
    agent.send(b"x", BEST, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)
    host.send(b"x", BEST, 9.0)
    deliver(host.datagrams_to_send(9.0), agent, 9.0)

    assert agent.srtt_s is None


def test_three_later_packets_make_a_packet_lost():
    agent, host = make_pair()
    for i in range(10):
        learn_round_trip(agent, host, now_s=1.0 + i)
    sent = []
    for _ in range(4):
        agent.send(b"x", RELIABLE, 20.0)
        sent += agent.datagrams_to_send(20.0)

    deliver(sent[1:3], host, 20.001)
    deliver(host.datagrams_to_send(20.001), agent, 20.002)
    assert agent.datagrams_to_send(20.002) == []
    deliver(sent[3:], host, 20.002)
    host.send(b"tick", BEST, 20.002)
    deliver(host.datagrams_to_send(20.002), agent, 20.003)

    (again,) = agent.datagrams_to_send(20.003)
    assert frames_in(sent[0]) == frames_in(again)


def test_packet_is_lost_some_time_after_a_later_one_arrived():
    agent, host = make_pair()
    for i in range(10):
        learn_round_trip(agent, host, now_s=1.0 + i)
    agent.send(b"lost", RELIABLE, 20.0)
    agent.datagrams_to_send(20.0)
    agent.send(b"tick", SYNC, 20.001)
    deliver(agent.datagrams_to_send(20.001), host, 20.002)
    deliver(host.datagrams_to_send(20.002), agent, 20.003)

    due_s = agent.get_timer()
    assert 20.003 < due_s < 20.01
    agent.handle_timer(due_s)
    (again,) = agent.datagrams_to_send(due_s)

    assert frames_in(again) == [(RELIABLE, 0)]


def test_needless_resend_is_counted_on_both_sides():
    agent, host = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    first = agent.datagrams_to_send(1.0)
    agent.handle_timer(1.2)
    again = agent.datagrams_to_send(1.2)
    for datagrams in (first, again):
        deliver(datagrams, host, 1.3)
    deliver(host.datagrams_to_send(1.3), agent, 1.4)

    assert [m.body for m in read(host)] == [b"x"]
    assert host.counters.reliable.duplicates == 1
    assert (agent.counters.reliable.resent, agent.counters.reliable.resent_spurious) == (1, 1)
    assert agent.get_timer() is None


def test_packet_held_to_be_lost_still_counts_when_it_arrives():
    """Its fragment waits to be sent again, but need not any more."""
    agent, host = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    first = agent.datagrams_to_send(1.0)
    agent.handle_timer(1.2)
    deliver(first, host, 1.2)
    deliver(host.datagrams_to_send(host.get_timer()), agent, 1.21)

    assert agent.datagrams_to_send(1.21) == []
    assert (agent.counters.reliable.resent, agent.counters.reliable.resent_spurious) == (0, 0)
    assert agent.is_flushed


def test_overtaken_acknowledgement_takes_nothing_back():
    agent, host = make_pair()
    acks = []
    for _ in range(2):
        agent.send(b"x", SYNC, 1.0)
        deliver(agent.datagrams_to_send(1.0), host, 1.001)
        acks += host.datagrams_to_send(1.001)
    agent.send(b"y", SYNC, 1.001)
    agent.datagrams_to_send(1.001)

    deliver(reversed(acks), agent, 1.002)

    assert agent.counters.sync.acknowledged == 2
    assert not agent.is_flushed


def test_unmet_deadline_is_reported_once():
    agent, _ = make_pair()
    agent.send(b"burn", SYNC, 1.0, channel=3, deadline_s=1.05)
    agent.datagrams_to_send(1.0)

    assert agent.get_timer() == 1.05
    agent.handle_timer(1.04)
    assert agent.next_broken_deadline() is None
    agent.handle_timer(1.05)

    expected = BrokenDeadline(
        index=0, channel=3, body=b"burn", sent_s=1.0, deadline_s=1.05, late_s=None
    )
    assert expected == agent.next_broken_deadline()
    assert agent.next_broken_deadline() is None
    agent.handle_timer(9.0)
    assert agent.next_broken_deadline() is None
    assert agent.counters.deadlines_broken == 1


def test_late_acknowledgement_says_how_late():
    agent, host = make_pair()
    agent.send(b"burn", SYNC, 1.0, deadline_s=1.05)
    deliver(agent.datagrams_to_send(1.0), host, 1.01)
    deliver(host.datagrams_to_send(1.01), agent, 1.08)

    assert agent.next_broken_deadline().late_s == pytest.approx(0.03)
    agent.handle_timer(1.09)
    assert agent.next_broken_deadline() is None
    assert agent.counters.deadlines_broken == 1


def test_met_deadline_is_not_reported():
    agent, host = make_pair()
    agent.send(b"burn", SYNC, 1.0, deadline_s=1.05)
    agent.send(b"burn", SYNC, 1.0, deadline_s=1.02)
    agent.send(b"burn", SYNC, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.001)
    deliver(host.datagrams_to_send(1.001), agent, 1.002)

    agent.handle_timer(9.0)

    assert agent.next_broken_deadline() is None
    assert agent.get_timer() is None


def test_deadlines_are_reported_in_the_order_of_time():
    agent, _ = make_pair()
    for deadline_s in (1.3, 1.1, 1.2):
        agent.send(b"burn", SYNC, 1.0, deadline_s=deadline_s)

    agent.handle_timer(1.25)

    assert agent.next_broken_deadline().deadline_s == 1.1
    assert agent.next_broken_deadline().deadline_s == 1.2
    assert agent.next_broken_deadline() is None


def test_acknowledgement_of_one_message_leaves_the_next_ones_deadline():
    agent, host = make_pair()
    agent.send(b"burn", SYNC, 1.0, deadline_s=1.05)
    deliver(agent.datagrams_to_send(1.0), host, 1.001)
    agent.send(b"burn", SYNC, 1.001, deadline_s=1.04)
    agent.datagrams_to_send(1.001)

    deliver(host.datagrams_to_send(1.002), agent, 1.003)
    agent.handle_timer(1.06)

    assert agent.next_broken_deadline().index == 1
    assert agent.next_broken_deadline() is None


def test_unread_reports_of_deadlines_are_bounded():
    agent, _ = make_pair()
    for _ in range(BROKEN_UNREAD_MAX + 5):
        agent.send(b"", SYNC, 1.0, deadline_s=1.0)
    agent.handle_timer(1.0)

    assert agent.counters.deadlines_broken == BROKEN_UNREAD_MAX + 5
    assert agent.next_broken_deadline().index == 5


def test_abandoned_link_counts_what_was_lost():
    agent, host = make_pair()
    agent.send(b"arrives", RELIABLE, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)
    deliver(host.datagrams_to_send(1.1), agent, 1.1)
    agent.send(b"does not", RELIABLE, 1.2)
    agent.send(b"does not", SYNC, 1.2)
    agent.datagrams_to_send(1.2)
    agent.send(b"nor this", RELIABLE, 1.2)

    agent.abandon()

    assert (agent.counters.reliable.acknowledged, agent.counters.reliable.lost) == (1, 2)
    assert agent.counters.sync.lost == 1
    assert agent.is_flushed
    assert agent.queued_bytes == 0
    assert agent.get_timer() is None
    assert agent.datagrams_to_send(5.0) == []


def test_counters_are_plain_mappings():
    wire = LossyWire(2, Faults(loss=0.1))
    wire.send(wire.agent, bytes(20_000), RELIABLE)
    wire.run_for(10.0)

    agent, host = (end.link.counters.to_mapping() for end in (wire.agent, wire.host))

    assert 1 == agent["reliable"]["sent"] == agent["reliable"]["acknowledged"]
    assert host["reliable"]["received"] == 1
    assert agent["reliable"]["resent"] > 0
    assert agent["bytes_sent"] == sum(len(d) for _, up, d in wire.carried if up)
    assert agent["datagrams_sent"] == sum(up for _, up, _ in wire.carried)
    assert {"short", "oversize", "version", "sender", "mac", "replay", "malformed"} == set(
        host["refused"]
    )


@pytest.mark.parametrize(
    ("window_bytes", "expected"),
    [(0, (4, 4)), (64 * 1024, (35, 11)), (1400 * 100, (75, 25)), (10**12, (65_535, 65_535))],
)
def test_windows_are_counted_in_datagrams_and_bounded(window_bytes, expected):
    assert expected == LinkLimits(receive_window_bytes=window_bytes).get_windows()


def test_unread_messages_are_granted_no_successors():
    agent, host = make_pair(receive_window_bytes=0)
    for _ in range(10):
        agent.send(bytes(1200), RELIABLE, 1.0)

    datagrams = agent.datagrams_to_send(1.0)
    deliver(datagrams, host, 1.0)
    deliver(host.datagrams_to_send(1.0), agent, 1.0)
    assert len(datagrams) == 4
    assert agent.datagrams_to_send(1.0) == []

    assert len(read(host)) == 4
    assert host.get_timer() == 1.0  # the grant is news
    deliver(host.datagrams_to_send(1.0), agent, 1.0)
    assert len(agent.datagrams_to_send(1.0)) == 4


def test_reading_some_of_the_messages_grants_nothing_yet():
    agent, host = make_pair(receive_window_bytes=0)
    for _ in range(4):
        agent.send(bytes(1200), RELIABLE, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)
    deliver(host.datagrams_to_send(1.0), agent, 1.0)

    for _ in range(3):
        assert host.next_message() is not None
        assert host.get_timer() is None
    assert host.next_message() is not None

    assert host.get_timer() == 1.0


def test_news_of_a_grant_are_not_put_off_by_the_next_packet():
    agent, host = make_pair()
    host.send(b"grants all", BEST, 1.0)
    deliver(host.datagrams_to_send(1.0), agent, 1.0)
    for _ in range(20):
        agent.send(bytes(1200), RELIABLE, 1.0)
    for now_s in (1.0, 1.1):
        deliver(agent.datagrams_to_send(now_s), host, now_s)
        deliver(host.datagrams_to_send(now_s), agent, now_s)
    deliver(host.datagrams_to_send(1.12), agent, 1.12)
    assert host.get_timer() is None
    assert len(read(host)) == 20
    assert host.get_timer() is not None

    agent.send(b"x", RELIABLE, 1.121)
    deliver(agent.datagrams_to_send(1.121), host, 1.121)

    assert host.get_timer() <= 1.121


def test_sender_without_a_grant_asks_for_one():
    """The timer is set when the last acknowledgement comes, whatever the owner calls next."""
    agent, host = make_pair(receive_window_bytes=0)
    for _ in range(5):
        agent.send(bytes(1200), RELIABLE, 1.0)
    deliver(agent.datagrams_to_send(1.0), host, 1.0)
    deliver(host.datagrams_to_send(1.0), agent, 1.0)

    due_s = agent.get_timer()
    assert due_s is not None
    agent.handle_timer(due_s)
    (probe,) = agent.datagrams_to_send(due_s)
    assert frames_in(probe) == []
    read(host)
    deliver([probe], host, due_s)
    deliver(host.datagrams_to_send(due_s), agent, due_s)

    assert [frames_in(d) for d in agent.datagrams_to_send(due_s)] == [[(RELIABLE, 4)]]


def test_fragment_that_waits_for_an_earlier_one_is_taken_once():
    agent, host = make_pair()
    agent.send(bytes(2000), RELIABLE, 1.0)
    first = agent.datagrams_to_send(1.0)
    deliver(first[1:], host, 1.0)
    now_s = 1.0
    for _ in range(2):
        now_s = agent.get_timer()
        agent.handle_timer(now_s)
        again = agent.datagrams_to_send(now_s)
    assert frames_in(again[0]) == [(RELIABLE, 1)]

    deliver(again, host, now_s)
    assert host.counters.reliable.duplicates == 1
    deliver(first[:1], host, now_s)

    assert [m.body for m in read(host)] == [bytes(2000)]


def test_lost_packets_remembered_are_bounded():
    agent, _ = make_pair()
    agent.send(b"x", RELIABLE, 1.0)
    agent.datagrams_to_send(1.0)
    for _ in range(2 * sending.LOST_PACKETS_MAX):
        now_s = agent.get_timer()
        agent.handle_timer(now_s)
        agent.datagrams_to_send(now_s)

    assert len(agent._outgoing.reliable._lost) == sending.LOST_PACKETS_MAX


def test_round_trip_is_smoothed():
    round_trip = RoundTrip()
    for sample_s in (0.1, 0.2):
        round_trip.add(sample_s)

    assert round_trip.srtt_s == pytest.approx(0.1125)
    assert round_trip.variation_s == pytest.approx(0.0625)
    assert round_trip.get_resend_delay(0) == pytest.approx(0.1125 + 4 * 0.0625 + ACK_DELAY_MAX_S)


def test_resend_delay_of_a_long_round_trip_never_shrinks():
    round_trip = RoundTrip()
    round_trip.add(3.0)

    assert round_trip.get_resend_delay(0) == round_trip.get_resend_delay(50) > 3.0


def test_pacer_allows_a_burst_and_then_the_rate():
    pacer = TokenBucket(1000.0, 500)

    pacer.spend(500, 10.0)
    assert pacer.opens_at_s == pytest.approx(10.0)
    pacer.spend(100, 10.0)
    assert pacer.opens_at_s == pytest.approx(10.1)
    pacer.spend(500, 20.0)
    assert pacer.opens_at_s == pytest.approx(20.0)
