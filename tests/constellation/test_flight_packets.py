"""Protocol `space_packets`: read by a reader of other people's making, by its own definitions, and broken by no bytes."""

import io
import random
import struct
from pathlib import Path

import pytest
import space_packet_parser
from space_packet_parser.generators.ccsds import ccsds_generator
from test_flight_frames import DELTA_V, FULL, SETUP

from madns_runtime.simulations.constellation.flight.interface import content
from madns_runtime.simulations.constellation.flight.interface.space_packets import (
    TIME,
    SpacePackets,
    packet_bytes,
)

DEFINITIONS = Path(__file__).parents[2] / "docs/flight-packets.xtce.xml"


def packet(one, t_s, values, tail=b"", *, count=0):
    body = TIME.pack(t_s) + one.pack(">", values, tail)
    return packet_bytes(one.number, count, body, is_telecommand=False)


def answer(t_s, number=0):
    one, values = DELTA_V
    return packet(one, t_s, values, count=number) + packet(
        content.DONE, t_s, {"board_us": 5}, count=number
    )


def test_a_reader_of_other_peoples_making_reads_every_packet_by_the_definitions():
    definitions = space_packet_parser.load_xtce(DEFINITIONS)
    vehicle = SpacePackets()
    sent = [*vehicle.setup(SETUP), *vehicle.tick(FULL), answer(0.1)]

    found = [definitions.parse_bytes(raw) for raw in ccsds_generator(io.BytesIO(b"".join(sent)))]

    assert [one["PKT_APID"] - 0x100 for one in found] == [1, *[2] * 5, 3, 4, 4, 5, 6, 7, 129, 136]
    setup, reading, message, result = found[0], found[6], found[7], found[9]
    assert setup["setup_name"].rstrip("\0") == "agent-01" and setup["setup_tick_hz"] == 10.0
    assert [one["SRC_SEQ_CTR"] for one in found[1:6]] == [0, 1, 2, 3, 4]
    assert reading["TIME"] == 0.1 and reading["reading_sensor"] == "gnss"
    values = struct.unpack(">6d", reading["reading_tail"])
    assert values == FULL.readings["gnss"].values
    assert message["message_tail"] == b"\0\1\2"
    assert result["result_status"] == "refused"
    assert found[-2]["delta_v_delta_v_m_s_y"] == 0.1 and found[-2]["delta_v_frame"] == "rtn"


def test_answers_are_read_however_they_are_cut():
    data = b"".join(answer(0.1 * n, n) for n in range(20))
    protocol = SpacePackets()

    got = [one for byte in data for one in protocol.feed(bytes([byte]))]

    assert [one.t_s for one in got] == [0.1 * n for n in range(20)]
    assert all(one.commands[0].value == (0.0, 0.1, 0.0) for one in got)
    assert not any(protocol.faults.values())


@pytest.mark.parametrize(
    ("data", "counts"),
    [
        (b"noise" + answer(0.1), {"corrupt": 1, "bytes_skipped": 5}),
        (answer(0.1) + answer(0.1), {"duplicate": 2}),
        (answer(0.1) + answer(0.2, 4), {"lost": 6}),
        (
            packet_bytes(136, 0, TIME.pack(0.1) + bytes(9), is_telecommand=False),
            {"wrong_length": 1, "bytes_skipped": 25},
        ),
        (answer(0.1)[:70], {"cut": 1, "bytes_skipped": 14}),
    ],
)
def test_what_is_damaged_is_counted_by_its_kind(data, counts):
    protocol = SpacePackets()
    hello = packet(content.HELLO, 0.0, {"board_us": 0})

    protocol.feed(data)
    (last,) = protocol.feed(hello + answer(7.0))

    assert last.t_s == 7.0
    assert {name: count for name, count in protocol.faults.items() if count} == counts


def log(text, number=0):
    return packet(content.LOG, 0.1, {"size": len(text), "level": 3}, text, count=number)


@pytest.mark.parametrize("kept", [3, 7, 15, 30, 200, 8000])
def test_a_packet_that_was_cut_holds_up_nothing_that_follows(kept):
    protocol = SpacePackets()
    protocol.feed(log(b"first"))
    protocol.feed(answer(0.1))

    (got,) = protocol.feed(log(b"x" * 8000, 1)[:kept] + answer(0.2, 1))

    assert got.t_s == 0.2 and got.commands
    found = {name: count for name, count in protocol.faults.items() if count}
    fault = "cut" if kept >= 6 else "corrupt"  # a header tells
    assert found in ({fault: 1, "bytes_skipped": kept}, {"wrong_length": 1, "bytes_skipped": kept})


def test_software_that_starts_anew_within_a_packet_is_heard_at_once():
    protocol = SpacePackets()
    protocol.feed(answer(0.1) + answer(0.2, 1) + log(b"x" * 500)[:100])

    (got,) = protocol.feed(packet(content.HELLO, 0.0, {"board_us": 1}) + answer(0.3))

    assert got.t_s == 0.3
    assert protocol.faults["cut"] == 1


@pytest.mark.parametrize("more", [1, 300, -40])
def test_a_length_that_its_kind_or_its_head_cannot_have_is_found_at_once(more):
    protocol = SpacePackets()
    for number, one in ((content.LOG.number, log(b"x" * 50)), (136, answer(0.1)[-24:])):
        whole = bytearray(one)
        length = int.from_bytes(whole[4:6], "big") + more
        whole[4:6] = (length & 0xFFFF).to_bytes(2, "big")
        protocol.feed(bytes(whole))
        (got,) = protocol.feed(answer(0.5, number))
        assert got.t_s == 0.5

    assert protocol.faults["wrong_length"] == 2


def test_a_text_of_more_than_a_log_may_have_is_no_packet():
    protocol = SpacePackets()
    protocol.feed(log(b"x" * (content.LOG_BYTES_MAX + 1)))
    protocol.feed(log(b"x" * content.LOG_BYTES_MAX))

    assert protocol.faults["wrong_length"] == 1
    (got,) = protocol.feed(answer(0.1))
    assert len(got.logs[0][1]) == content.LOG_BYTES_MAX


def test_packets_in_the_payload_of_another_stay_its_payload():
    protocol = SpacePackets()
    protocol.feed(answer(0.1) + answer(0.2, 1))
    payload = answer(0.1) + answer(0.2, 1) + answer(9.0, 40)
    body = {"to": "agent-02", "size": len(payload), "encoding": 0}
    relayed = packet(content.SEND, 0.3, body, payload)

    got = [one for byte in relayed + answer(0.3, 2) for one in protocol.feed(bytes([byte]))]

    assert [one.t_s for one in got] == [0.3]
    assert got[0].sends == (("agent-02", payload),)
    assert not any(protocol.faults.values())


def test_seeded_noise_is_counted_and_raises_nothing():
    chance = random.Random(12)
    protocol = SpacePackets()
    for number in range(300):
        data = bytearray(answer(0.1 * number, number))
        for _ in range(chance.randrange(3)):
            place = chance.randrange(len(data))
            if chance.randrange(2):
                data[place] = chance.randrange(256)
            else:
                del data[place : place + chance.randrange(9)]
        protocol.feed(bytes(data))
    protocol.feed(chance.randbytes(50_000))

    assert protocol.faults["corrupt"] > 30 and protocol.faults["lost"] > 50
