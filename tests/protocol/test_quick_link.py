"""The quick way of a link and of the codec, call by call, beside the general one."""

import random
from struct import Struct

import pytest
from harness.host_links import host_link
from hypothesis import given
from hypothesis import strategies as st
from lossy_wire import RUN_KEY, SESSION

from madns_runtime.protocol.codec import (
    ITEMS_MAX,
    NO_DATA,
    MalformedMessage,
    UnencodableValue,
    decode_data,
    decode_message,
    encode_data,
    encode_message,
)
from madns_runtime.protocol.datagram import (
    BEST_BYTES_MAX,
    DATAGRAM_BYTES_MAX,
    MAC_BYTES,
    OVERHEAD_BYTES,
)
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.messages import Ping, Service, SimulationData
from madns_runtime.protocol.packets import (
    ACK_BITS,
    MEASURE_INTERVAL_S,
    REPLAY_WINDOW_PACKETS,
    Packets,
)

BEST, RELIABLE, SYNC = Service


def make_pair():
    return (
        Link.for_agent(RUN_KEY, SESSION, 1, 2),
        host_link(RUN_KEY, SESSION, 1, 2),
    )


def greet(agent, host, now_s=0.0):
    """Let one datagram go each way, so that each side knows what the other says of the streams."""
    for one, other in ((agent, host), (host, agent)):
        one.send(b"hello", BEST, now_s)
        (data,) = one.datagrams_to_send(now_s)
        assert other.receive_datagram(data, now_s)
        assert other.next_message().body == b"hello"


def general(link, body, now_s, channel=1):
    link.send(body, BEST, now_s, channel=channel)
    (data,) = link.datagrams_to_send(now_s)
    return data


def state(link):
    return (link.counters.to_mapping(), link.srtt_s, link.get_timer())


# Sending.


def test_quick_datagrams_are_those_of_the_general_way_bit_by_bit():
    (quick, host_1), (slow, host_2) = make_pair(), make_pair()
    for step in range(200):
        now_s = step * 0.01
        channel = step % 3
        body = bytes(step)

        data = quick.seal_best(body, now_s, channel=channel)
        assert data == general(slow, body, now_s, channel)

        for host, link in ((host_1, quick), (host_2, slow)):
            host.receive_datagram(data, now_s)
            while host.next_message():
                pass
            if step % 7 == 0:
                host.send(bytes(step), RELIABLE if step % 2 else SYNC, now_s)
            for answer in host.datagrams_to_send(now_s):
                link.receive_datagram(answer, now_s + 0.001)
                while link.next_message():
                    pass
        assert state(quick) == state(slow)


def test_quick_datagram_carries_an_acknowledgement_that_is_owed():
    agent, host = make_pair()
    host.send(b"order", SYNC, 0.0)
    (order,) = host.datagrams_to_send(0.0)
    agent.receive_datagram(order, 0.001)
    assert agent.next_message().body == b"order"

    data = agent.seal_best(b"tick", 0.002, channel=1)

    assert agent.datagrams_to_send(0.002) == []
    host.receive_datagram(data, 0.003)
    assert host.is_flushed


def test_message_does_not_overtake_those_that_wait():
    agent, _ = make_pair()
    agent.send(b"first", BEST, 0.0, channel=1)
    before = state(agent)

    assert agent.seal_best(b"second", 0.0, channel=1) is None
    assert state(agent) == before


def test_longest_message_goes_the_quick_way_and_a_longer_one_is_left_alone():
    agent, host = make_pair()

    data = agent.seal_best(bytes(BEST_BYTES_MAX), 0.0, channel=1)
    assert len(data) == DATAGRAM_BYTES_MAX
    assert host.receive_datagram(data, 0.0)
    before = state(agent)

    assert agent.seal_best(bytes(BEST_BYTES_MAX + 1), 0.0, channel=1) is None
    assert state(agent) == before


# Receiving.


def test_quick_way_opens_what_the_general_one_does_with_the_same_account():
    (agent_1, quick), (agent_2, slow) = make_pair(), make_pair()
    greet(agent_1, quick)
    greet(agent_2, slow)
    for step in range(1, 100):
        now_s = step * 2 * MEASURE_INTERVAL_S  # so seldom that each side measures every round trip
        data = general(agent_1, bytes(step), now_s)
        assert data == general(agent_2, bytes(step), now_s)

        assert quick.open_best(data, now_s + 0.001) == bytes(step)
        assert slow.receive_datagram(data, now_s + 0.001)
        assert slow.next_message() == (BEST, 1, bytes(step))

        assert state(quick) == state(slow)
        answers = [general(host, b"answer", now_s + 0.002) for host in (quick, slow)]
        assert answers[0] == answers[1]
        for agent in (agent_1, agent_2):
            assert agent.receive_datagram(answers[0], now_s + 0.003)
            assert agent.next_message().body == b"answer"


def test_round_trips_are_measured_now_and_then():
    agent, host = make_pair()
    greet(agent, host)
    assert agent.srtt_s is not None
    first_s = agent.srtt_s
    srtts = []
    for step in range(100):
        now_s = 1 + step * 0.01
        host.open_best(general(agent, b"x", now_s), now_s + 0.002)
        assert agent.open_best(general(host, b"y", now_s + 0.002), now_s + 0.004) == b"y"
        srtts.append(agent.srtt_s)

    assert 5 <= len(set(srtts)) <= 12
    assert first_s < srtts[-1] == pytest.approx(0.004, rel=0.3)


def not_opened(host, data, now_s=1.0):
    before = state(host)
    opened = host.open_best(data, now_s)
    assert state(host) == before
    return opened is None


def test_datagrams_out_of_order_and_repeated_ones_go_the_general_way():
    agent, host = make_pair()
    greet(agent, host)
    first, second, third = (general(agent, body, 0.1) for body in (b"1", b"2", b"3"))

    assert not_opened(host, second)
    assert host.receive_datagram(second, 0.2)
    assert not_opened(host, first)
    assert not_opened(host, second)
    assert host.next_message().body == b"2"
    assert host.open_best(third, 0.3) == b"3"
    assert not_opened(host, third)
    assert not host.receive_datagram(third, 0.4)
    assert host.counters.best.lost == 1


def test_message_that_follows_a_gap_in_its_channel_goes_the_general_way():
    agent, host = make_pair()
    greet(agent, host)
    for _ in range(300):
        agent.send(b"x", BEST, 0.1, channel=1)  # more than wait: the oldest give way
    datagrams = agent.datagrams_to_send(0.1)

    assert not_opened(host, datagrams[0])
    for data in datagrams:
        assert host.receive_datagram(data, 0.1)
    assert host.counters.best.lost == 300 - 256


def test_two_messages_in_a_datagram_go_the_general_way():
    agent, host = make_pair()
    greet(agent, host)
    agent.send(b"1", BEST, 0.1, channel=1)
    agent.send(b"2", BEST, 0.1, channel=1)
    (data,) = agent.datagrams_to_send(0.1)

    assert not_opened(host, data)
    assert host.receive_datagram(data, 0.1)
    assert [host.next_message().body for _ in range(2)] == [b"1", b"2"]


@pytest.mark.parametrize("service", [RELIABLE, SYNC])
def test_messages_of_streams_go_the_general_way_and_so_does_the_first_after_them(service):
    agent, host = make_pair()
    greet(agent, host)
    agent.send(b"stream", service, 0.1)
    (data,) = agent.datagrams_to_send(0.1)
    assert not_opened(host, data)
    host.receive_datagram(data, 0.1)
    assert host.next_message().body == b"stream"

    agent.receive_datagram(host.seal_best(b"answer", 0.1, channel=1), 0.101)
    agent.next_message()
    answer = host.seal_best(b"answer", 0.11, channel=1)

    assert agent.open_best(answer, 0.111) == b"answer"
    assert host.open_best(agent.seal_best(b"tick", 0.12, channel=1), 0.121) == b"tick"


def test_while_a_stream_waits_for_acknowledgements_every_datagram_goes_the_general_way():
    agent, host = make_pair()
    greet(agent, host)
    host.send(b"order", SYNC, 0.1)
    host.datagrams_to_send(0.1)  # lost

    tick = agent.seal_best(b"tick", 0.11, channel=1)
    assert not_opened(host, tick)
    assert host.receive_datagram(tick, 0.11)
    assert host.next_message().body == b"tick"


def test_messages_that_wait_are_not_overtaken():
    agent, host = make_pair()
    greet(agent, host)
    first, second = general(agent, b"1", 0.1), general(agent, b"2", 0.1)
    host.receive_datagram(first, 0.1)

    assert not_opened(host, second)


def test_no_changed_bit_and_no_length_passes():
    agent, host = make_pair()
    greet(agent, host)
    data = general(agent, b"tick", 0.1)
    generator = random.Random(1)

    for bit in range(8 * len(data)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        assert not_opened(host, bytes(changed))
    for length in range(len(data)):
        assert not_opened(host, data[:length])
    for _ in range(200):
        assert not_opened(host, data[:-MAC_BYTES] + generator.randbytes(MAC_BYTES))
        assert not_opened(host, generator.randbytes(generator.randrange(1500)))
    assert not_opened(host, data + bytes(DATAGRAM_BYTES_MAX))
    assert host.open_best(data, 0.1) == b"tick"


def test_acknowledgement_of_a_packet_never_sent_goes_the_general_way_and_is_refused():
    agent, host = make_pair()
    greet(agent, host)
    agent._packets.largest = 1000

    data = agent.seal_best(b"tick", 0.1, channel=1)

    assert not_opened(host, data)
    assert not host.receive_datagram(data, 0.1)
    assert host.counters.refused["malformed"] == 1


# Packets received.


def all_bits(packets):
    return [packets.is_new(number) for number in range(packets.largest + 3)]


@given(st.lists(st.integers(1, 60), max_size=80), st.integers(0, 200))
def test_received_packets_are_known_one_by_one_whatever_their_order(numbers, in_order):
    packets = Packets()
    seen = set()
    for number in [*numbers, *range(100, 100 + in_order)]:
        assert packets.is_new(number) == (number not in seen)
        if number not in seen:
            packets.add(number, 0.0)
            seen.add(number)
        largest = max(seen)
        bits = sum(1 << i for i in range(ACK_BITS) if largest - 1 - i in seen)
        assert packets.depart(0.0)[1:3] == (largest, packets.ack_bits) == (largest, bits)


def test_long_run_in_order_forgets_what_is_older_than_the_window():
    packets = Packets()
    packets.add(2, 0.0)  # 1 is missing
    for number in range(3, 2 * REPLAY_WINDOW_PACKETS):
        packets.add(number, 0.0)

    assert not any(all_bits(packets)[:-2])
    assert all(all_bits(packets)[-2:])


@pytest.mark.parametrize(("later_s", "delay"), [(-1.0, 0), (0.0, 0), (0.01, 1000), (5.0, 65_535)])
def test_delay_of_an_acknowledgement_is_bounded(later_s, delay):
    packets = Packets()
    packets.add(1, 10.0)

    assert packets.depart(10.0 + later_s)[3] == pytest.approx(delay, abs=1)


# Messages.

SCALARS = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.text() | st.binary()
) | st.floats(allow_nan=False)
PAYLOADS = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)


@pytest.mark.slow
@given(PAYLOADS)
def test_data_are_encoded_as_any_message_is_and_decoded_if_they_are_plain(payload):
    body = encode_data(payload)

    assert body == encode_message(SimulationData(payload))
    assert decode_message(body) == SimulationData(payload)
    is_plain = type(payload) is list and not any(type(x) in (list, dict) for x in payload)
    if decode_data(body) is NO_DATA:
        assert not is_plain or len(body) > 1024
    else:
        assert decode_data(body) == payload


@pytest.mark.parametrize("bad", [2**64, -(2**63) - 1, "\ud800"])
def test_plain_list_with_what_cannot_travel_is_refused_and_harms_none_after_it(bad):
    with pytest.raises(UnencodableValue):
        encode_data([1, bad])

    assert decode_data(encode_data([1, 2])) == [1, 2]


def test_list_that_is_too_long_is_refused():
    assert len(encode_data([0] * ITEMS_MAX)) > ITEMS_MAX
    with pytest.raises(UnencodableValue):
        encode_data([0] * (ITEMS_MAX + 1))


@given(st.binary(max_size=40))
def test_bytes_of_a_stranger_are_data_only_if_they_are_a_message(tail):
    body = bytes([SimulationData.KIND, 0x91]) + tail

    payload = decode_data(body)

    if payload is not NO_DATA:
        assert decode_message(body) == SimulationData(payload)


def test_other_messages_are_no_data():
    assert decode_data(encode_message(Ping(1.0, {}))) is NO_DATA
    assert decode_data(b"") is NO_DATA


def test_timestamps_and_extensions_are_left_to_the_general_way():
    for item in (b"\xd6\xff\x00\x00\x00\x01", b"\xd4\x05\x00"):
        body = bytes([SimulationData.KIND, 0x91, 0x91]) + item

        assert decode_data(body) is NO_DATA
    with pytest.raises(MalformedMessage):
        decode_message(body)


def test_header_of_a_quick_datagram_has_the_size_of_every_header():
    agent, _ = make_pair()
    frame = Struct("<BBHQ")

    data = agent.seal_best(b"12345", 0.0, channel=1)

    assert len(data) == OVERHEAD_BYTES + frame.size + 5
