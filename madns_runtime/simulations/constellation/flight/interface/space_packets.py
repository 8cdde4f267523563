"""
Protocol `space_packets`: the same structs in Space Packets of CCSDS 133.0-B. Pure.

    primary header (6) | secondary header: simulated time of the tick, float64 (8) | struct | tail | CRC-16 (2)

All big-endian. One APID for each kind of content, APID_FIRST plus its number, with a sequence count of its own; what
goes to the program has packet type telecommand, what comes from it telemetry; every packet is unsegmented. The last
two bytes are the packet error control of ECSS-E-ST-70-41C: CRC-16 with polynomial 0x1021 from 0xFFFF over all before.
docs/flight-packets.xtce.xml defines all of them.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterable
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
PACKET_BYTES_MAX: Final = (
    OVERHEAD_BYTES + max(each.size for each in content.FROM_PROGRAM) + content.TAIL_BYTES_MAX
)
"""Of a packet from the program."""
KNOWN: Final = frozenset(HAS_SECONDARY | APID_FIRST + each.number for each in content.FROM_PROGRAM)
"""First two bytes of the packets that are expected from it."""


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
        place = 0
        view = bytes(self._buffer)
        while len(view) - place >= HEADER.size:
            size = self._size_at(view, place)
            if size is None:
                self._skip()
                place += 1
                continue
            if len(view) - place < size:
                break
            packet = view[place : place + size]
            if binascii.crc_hqx(packet[: -CRC.size], 0xFFFF) != CRC.unpack(packet[-CRC.size :])[0]:
                self._skip()
                place += 1
                continue
            self._is_in_step = True
            place += size
            answer = self._take(packet)
            if answer is not None:
                answers.append(answer)
        del self._buffer[:place]
        return answers

    def _size_at(self, data: bytes, place: int) -> int | None:
        """Return how long the packet is whose header stands at a place; None if none can stand there."""
        first, sequence, length = HEADER.unpack_from(data, place)
        size = HEADER.size + length + 1
        if first not in KNOWN or sequence < UNSEGMENTED:
            return None
        return size if OVERHEAD_BYTES <= size <= PACKET_BYTES_MAX else None

    def _skip(self) -> None:
        """Count a byte that belongs to no packet, and once what was lost of step by it."""
        self.faults["bytes_skipped"] += 1
        self.faults["corrupt"] += self._is_in_step
        self._is_in_step = False

    def _take(self, packet: bytes) -> FlightAnswer | None:
        first, sequence, _ = HEADER.unpack_from(packet)
        (t_s,) = TIME.unpack_from(packet, HEADER.size)
        number = (first & 0x7FF) - APID_FIRST
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
