"""
Protocol `space_packets`: the same structs in Space Packets of CCSDS 133.0-B. Pure.

    primary header (6) | secondary header: simulated time of the tick, float64 (8) | struct | tail | CRC-16 (2)

All big-endian. One APID for each kind of content, APID_FIRST plus its number, with a sequence count of its own; what
goes to the program has packet type telecommand, what comes from it telemetry; every packet is unsegmented. The last
two bytes are the packet error control of ECSS-E-ST-70-41C: CRC-16 with polynomial 0x1021 from 0xFFFF over all before.
docs/flight-packets.xtce.xml defines all of them.

A stream of packets has no mark between them. What stands where a packet should begin and has the length of no packet
of its kind is given up at once; and while a packet is not all there, one that is whole and next in its sequence is looked
for behind its header: a packet that was cut holds up nothing that follows.
"""

from __future__ import annotations

import binascii
import re
import struct
from collections.abc import Iterable, Iterator
from typing import Final

from madns_runtime.simulations.constellation.flight.interface import content
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer
from madns_runtime.simulations.constellation.flight.interface.dialogue import (
    Dialogue,
    Said,
    SequenceCount,
)
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport

APID_FIRST: Final = 0x100
HEADER: Final = struct.Struct(">HHH")
TIME: Final = struct.Struct(">d")
CRC: Final = struct.Struct(">H")
TELECOMMAND: Final = 1 << 12
HAS_SECONDARY: Final = 1 << 11
UNSEGMENTED: Final = 3 << 14
COUNTS: Final = 1 << 14
"""SequenceCount counts of an APID."""
OVERHEAD_BYTES: Final = HEADER.size + TIME.size + CRC.size
KNOWN: Final = {HAS_SECONDARY | APID_FIRST + one.number: one for one in content.FROM_PROGRAM}
"""Content of the packets that are expected from the program, by their first two bytes."""
START: Final = re.compile(
    b"|".join(
        b"%b(?:\\Z|%b(?:\\Z|[\xc0-\xff]))" % tuple(map(re.escape, (first[:1], first[1:])))
        for first in (struct.pack(">H", one) for one in KNOWN)
    ),
    re.DOTALL,
)
"""Where such a packet may begin, the end of what has come included."""


class SpacePackets:
    """Both directions of a conversation in Space Packets."""

    def __init__(self) -> None:
        self._dialogue = Dialogue()
        self.faults = self._dialogue.faults
        """Counts of what could not be taken, by kind; bytes between packets are `corrupt`."""
        self.faults["bytes_skipped"] = 0
        self._counts = dict.fromkeys(content.BY_NUMBER, 0)
        self._taken = {
            each.number: SequenceCount(COUNTS, self.faults) for each in content.FROM_PROGRAM
        }
        self._buffer = bytearray()
        self._is_in_step = True
        self._t_s = 0.0

    def setup(self, setup: SetupReport) -> list[bytes]:
        """Return the packets that tell flight software who it is."""
        return self._packets(self._dialogue.setup(setup))

    def tick(self, tick: TickReport) -> list[bytes]:
        """Return the packets of a tick; of one after a hello, the setup before them."""
        self._t_s = tick.t_s
        again = self._packets(self._dialogue.setup_again())
        return again + self._packets(self._dialogue.tick(tick))

    def feed(self, data: bytes) -> list[FlightAnswer]:
        """Take what came, and return the answers that are whole now."""
        self._buffer += data
        answers = []
        while (packet := self._next_packet()) is not None:
            answer = self._take(packet)
            if answer is not None:
                answers.append(answer)
        return answers

    def _next_packet(self) -> bytes | None:
        """Take the next whole, valid packet off the buffer, and what belongs to none before it; None if more must come first."""
        data = bytes(self._buffer)
        waiting: int | None = None
        for place in _starts(data):
            size = _size_at(data, place)
            if size is None:
                continue
            packet = data[place : place + size]
            if not size or len(packet) < size:
                waiting = place if waiting is None else waiting
            elif _is_valid(packet) and (waiting is None or self._may_follow_one_cut(packet)):
                self._skip(data[:place])
                del self._buffer[: place + size]
                self._is_in_step = True
                return packet
        keep = len(data) if waiting is None else waiting
        self._skip(data[:keep])
        del self._buffer[:keep]
        return None

    def _may_follow_one_cut(self, packet: bytes) -> bool:
        """Tell a packet of the stream from one that is the payload of another, of which not all is there yet."""
        first, sequence, _ = HEADER.unpack_from(packet)
        number = KNOWN[first].number
        return number == content.HELLO.number or self._taken[number].is_next(sequence % COUNTS)

    def _skip(self, data: bytes) -> None:
        """Count bytes that belong to no packet, and once what was lost of step by them."""
        if not data:
            return
        self.faults["bytes_skipped"] += len(data)
        if self._is_in_step:
            self.faults[_fault_of(data)] += 1
        self._is_in_step = False

    def _take(self, packet: bytes) -> FlightAnswer | None:
        first, sequence, _ = HEADER.unpack_from(packet)
        (t_s,) = TIME.unpack_from(packet, HEADER.size)
        number = KNOWN[first].number
        if number == content.HELLO.number:
            for each in self._taken.values():
                each.restart()
        if not self._taken[number].takes(sequence % COUNTS):
            return None
        body = packet[HEADER.size + TIME.size : -CRC.size]
        return self._dialogue.take(number, t_s, ">", body)

    def _packets(self, said: Iterable[Said]) -> list[bytes]:
        return [self._packet(one) for one in said]

    def _packet(self, said: Said) -> bytes:
        number = said.content.number
        count = self._counts[number]
        self._counts[number] = (count + 1) % COUNTS
        body = TIME.pack(self._t_s) + said.content.pack(">", said.values, said.tail)
        return packet_bytes(number, count, body, is_telecommand=True)


def _starts(data: bytes) -> Iterator[int]:
    """Yield the places at which a packet may begin."""
    match = START.search(data)
    while match is not None:
        yield match.start()
        match = START.search(data, match.start() + 1)


def _size_at(data: bytes, place: int) -> int | None:
    """Return the length of a packet by its header and its struct; 0 if they are not there yet, None if it is none."""
    if len(data) - place < HEADER.size:
        return 0
    first, _, length = HEADER.unpack_from(data, place)
    size, known = HEADER.size + int(length) + 1, KNOWN[first]
    if not known.is_size(size - OVERHEAD_BYTES):
        return None
    begin = place + HEADER.size + TIME.size
    told = known.told_size(">", data[begin : begin + known.size])
    return size if told in (None, size - OVERHEAD_BYTES) else None


def _is_valid(packet: bytes) -> bool:
    (crc,) = CRC.unpack(packet[-CRC.size :])
    return bool(binascii.crc_hqx(packet[: -CRC.size], 0xFFFF) == crc)


def _fault_of(data: bytes) -> str:
    """Return what is wrong with what stands where a packet should."""
    if len(data) < HEADER.size or START.match(data) is None:
        return "corrupt"
    size = _size_at(data, 0)
    if size is None:
        return "wrong_length"
    return "cut" if len(data) < size else "corrupt"


def packet_bytes(number: int, count: int, body: bytes, *, is_telecommand: bool) -> bytes:
    """
    Return one packet.

    Args:
        number: Of its content.
        count: Of its APID's sequence.
        body: Secondary header, struct and tail.
        is_telecommand: Whether it goes to the program.
    """
    first = HAS_SECONDARY | APID_FIRST + number | (TELECOMMAND if is_telecommand else 0)
    whole = HEADER.pack(first, UNSEGMENTED | count, len(body) + CRC.size - 1) + body
    return whole + CRC.pack(binascii.crc_hqx(whole, 0xFFFF))
