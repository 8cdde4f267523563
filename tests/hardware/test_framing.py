"""Frames in a stream of bytes: found whole, after any garbage, in bounded memory."""

from __future__ import annotations

import random

import pytest

from madns_runtime.errors import PluginError
from madns_runtime.hardware.framing import (
    FRAMERS,
    CobsFramer,
    LengthFramer,
    LineFramer,
    NmeaFramer,
    UbxFramer,
    cobs_decode,
    cobs_encode,
)

TEXT = ("lines", "nmea")
WRAPPED = ("lines", "nmea", "ubx", "cobs", "length_prefixed")


def body_of(framing: str, length: int, seed: int) -> bytes:
    numbers = random.Random(seed)
    if framing in TEXT:
        return bytes(numbers.choice(b"ABCxyz019,.-") for _ in range(length))
    return numbers.randbytes(length)


@pytest.mark.parametrize("framing", WRAPPED)
@pytest.mark.parametrize("length", [2, 3, 80, 253, 254, 255, 509, 1024])
def test_what_is_wrapped_is_found_however_it_is_cut(framing, length):
    for cut in (1, 7, 64):
        framer = FRAMERS[framing](1024)
        bodies = [body_of(framing, length, seed) for seed in range(5)]
        stream = b"".join(map(framer.wrap, bodies))
        found = []
        for start in range(0, len(stream), cut):
            found += framer.feed(stream[start : start + cut])

        assert found == bodies
        assert framer.garbage_bytes == framer.bad_checksums == 0


@pytest.mark.parametrize("framing", WRAPPED)
def test_garbage_at_full_rate_takes_no_memory_and_the_next_good_frames_are_found(framing):
    framer = FRAMERS[framing](256)
    numbers = random.Random(7)
    for _ in range(200):
        framer.feed(numbers.randbytes(4096))
        assert len(framer._buffer) <= 2 * 256 + 8192
    good = [body_of(framing, 40, seed) for seed in range(60)]

    found = [frame for body in good for frame in framer.feed(framer.wrap(body))]

    assert good[-1] in found
    assert framer.garbage_bytes > 100_000 or framing in ("lines", "length_prefixed")


def test_raw_gives_what_came_in_pieces_of_at_most_the_longest_frame():
    framer = FRAMERS["raw"](4)

    assert framer.feed(b"abcdefghij") == [b"abcd", b"efgh", b"ij"]


def test_too_long_a_line_is_garbage():
    framer = LineFramer(8)

    assert framer.feed(b"123456789012\nshort\r\n") == [b"short"]
    assert framer.garbage_bytes == 13


@pytest.mark.parametrize("framing", ["lines", "nmea", "cobs"])
@pytest.mark.parametrize("cut", [1, 10, 1000])
def test_of_too_long_a_frame_no_part_is_a_frame_however_it_is_cut(framing, cut):
    framer = FRAMERS[framing](16)
    # Its tail by itself would be a good frame.
    stream = b"x" * 40 + FRAMERS[framing](16).wrap(b"tail")
    found = []
    for start in range(0, len(stream), cut):
        found += framer.feed(stream[start : start + cut])

    assert found == []
    assert framer.garbage_bytes == len(stream)
    assert framer.feed(framer.wrap(b"good")) == [b"good"]


@pytest.mark.parametrize("framing", ["lines", "nmea"])
def test_a_frame_a_byte_too_long_is_garbage_also_where_its_line_has_no_carriage_return(framing):
    framer = FRAMERS[framing](8)
    line = FRAMERS[framing](16).wrap(b"ABCDEFGHI").replace(b"\r", b"")

    assert framer.feed(line) == []
    assert framer.garbage_bytes == len(line)
    assert framer.feed(framer.wrap(b"ABCDEFGH")) == [b"ABCDEFGH"]


def test_sentence_of_a_receiver_is_checked():
    framer = NmeaFramer()
    good = b"$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,M,55.2,M,,*76\r\n"

    assert framer.feed(good)[0].startswith(b"GPGGA,092750")
    assert framer.feed(good.replace(b"5321", b"5322")) == []
    assert framer.bad_checksums == 1


@pytest.mark.parametrize("frame", [b"GO\nSTOP", b"GO\r\nSTOP\r\n", b"\n\n"])
def test_several_lines_are_not_sent_as_one_frame(frame):
    with pytest.raises(PluginError, match="expected one line, got 2: .* or use framing: raw"):
        LineFramer().wrap(frame)


@pytest.mark.parametrize("end", [b"", b"\n", b"\r\n"])
def test_a_line_that_brings_its_end_along_is_sent_with_one(end):
    assert LineFramer().wrap(b"GO" + end) == b"GO\r\n"


@pytest.mark.parametrize(
    "frame", [b"$PMTK,1*2F", b"PMTK,1*2F", b"PMTK,1\r\n", b"PMTK\nPMTK", b"$P"]
)
def test_what_would_be_another_sentence_is_refused(frame):
    with pytest.raises(
        PluginError, match=r"expected a sentence without \$, checksum and line end.*; got b'"
    ):
        NmeaFramer().wrap(frame)


def test_message_of_a_receiver_is_as_its_description_says():
    # UBX-ACK-ACK for CFG-MSG: class 05, number 01, payload 06 01, checksum 0F 38.
    wire = bytes.fromhex("b5620501020006010f38")

    assert UbxFramer().feed(b"noise" + wire) == [bytes.fromhex("05010601")]
    assert UbxFramer().wrap(bytes.fromhex("05010601")) == wire


@pytest.mark.parametrize(
    ("plain", "stuffed"),
    [
        ("00", "0101"),
        ("0000", "010101"),
        ("11220033", "0311220233"),
        ("11000000", "0211010101"),
    ],
)
def test_stuffing_is_the_published_one(plain, stuffed):
    assert cobs_encode(bytes.fromhex(plain)).hex() == stuffed
    assert cobs_decode(bytes.fromhex(stuffed)) == bytes.fromhex(plain)


def test_stuffing_that_cannot_be_is_garbage():
    framer = CobsFramer()

    assert framer.feed(b"\x05\x11\x00" + framer.wrap(b"good")) == [b"good"]
    assert framer.garbage_bytes == 3


@pytest.mark.parametrize("cut", [1, 3, 100])
def test_frames_of_nothing_between_others_cost_none_of_them(cut):
    stream = b"".join(LengthFramer().wrap(frame) for frame in (b"", b"one", b"", b"", b"two"))
    framer, found = LengthFramer(), []
    for start in range(0, len(stream), cut):
        found += framer.feed(stream[start : start + cut])

    assert found == [b"one", b"two"]
    assert framer.garbage_bytes == 0


def test_length_may_be_big_endian_and_of_four_bytes():
    framer = LengthFramer(64, 4, "big")

    assert framer.wrap(b"abc") == b"\0\0\0\3abc"
    assert framer.feed(b"\0\0\0\3abc") == [b"abc"]


@pytest.mark.parametrize("digits", [b"05", b"+5", b" 5", b"5 ", b"-5", b"0x"])
def test_a_checksum_of_nmea_is_two_hexadecimal_digits(digits: bytes) -> None:
    framer = NmeaFramer()

    found = framer.feed(b"$\x05*" + digits + b"\r\n")

    assert found == ([b"\x05"] if digits == b"05" else [])
    assert framer.bad_checksums == 1 - len(found)
