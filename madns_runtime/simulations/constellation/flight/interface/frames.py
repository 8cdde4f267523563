"""
Protocol `frames`: structs for a microcontroller, in frames that survive a serial line. Pure.

    COBS( header | struct | tail | CRC-32 ) 00

All little-endian. The header has 16 bytes: type, version (1), sequence number, bytes between header and CRC,
two reserved bytes, and the simulated time of the tick as float64. CRC-32 is that of Ethernet (zlib.crc32) over all
before it. COBS: Cheshire and Baker, 1999. The C side is flight_frames.h.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from typing import Final

from madns_runtime.hardware.framing import cobs_decode, cobs_encode
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer
from madns_runtime.simulations.constellation.flight.interface.content import (
    FROM_PROGRAM,
    TAIL_BYTES_MAX,
)
from madns_runtime.simulations.constellation.flight.interface.dialogue import (
    Dialogue,
    Said,
    SequenceCount,
)
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport

VERSION: Final = 1
HEADER: Final = struct.Struct("<BBHHHd")
CRC: Final = struct.Struct("<I")
FRAME_BYTES_MAX: Final = (
    HEADER.size + max(each.size for each in FROM_PROGRAM) + TAIL_BYTES_MAX + CRC.size
)
"""Of a frame from the program, before stuffing."""
STUFFED_BYTES_MAX: Final = FRAME_BYTES_MAX + FRAME_BYTES_MAX // 254 + 1
HELLO: Final = 128


class Frames:
    """Both directions of a conversation in frames."""

    unended = "which is no whole frame: text goes to standard error"
    """Words on a rest that does not go on."""

    def __init__(self) -> None:
        self._dialogue = Dialogue()
        self.faults = self._dialogue.faults
        """Counts of what could not be taken, by kind."""
        self._numbers = SequenceCount(1 << 16, self.faults)
        self._sequence = 0
        self._buffer = bytearray()
        self._is_skipping = False
        self._t_s = 0.0

    @property
    def rest(self) -> bytes:
        """Bytes that came and are nothing whole yet."""
        return bytes(self._buffer)

    def setup(self, setup: SetupReport) -> list[bytes]:
        """Return the frames that tell flight software who it is."""
        return self._frames(self._dialogue.setup(setup))

    def tick(self, tick: TickReport) -> list[bytes]:
        """Return the frames of a tick; of one after a hello, the setup before them."""
        self._t_s = tick.t_s
        again = self._frames(self._dialogue.setup_again())
        return again + self._frames(self._dialogue.tick(tick))

    def feed(self, data: bytes) -> list[FlightAnswer]:
        """Take what came, and return the answers that are whole now."""
        *ended, rest = data.split(b"\0")
        answers = []
        for part in ended:
            self._buffer += part
            if self._is_skipping or len(self._buffer) > STUFFED_BYTES_MAX:
                self.faults["overlong"] += not self._is_skipping
            elif self._buffer and (answer := self._take(bytes(self._buffer))) is not None:
                answers.append(answer)
            self._is_skipping = False
            self._buffer.clear()
        self._buffer += rest if not self._is_skipping else b""
        if len(self._buffer) > STUFFED_BYTES_MAX:
            self.faults["overlong"] += 1
            self._is_skipping = True
            self._buffer.clear()
        return answers

    def _frames(self, said: Iterable[Said]) -> list[bytes]:
        return [self._frame(one) for one in said]

    def _frame(self, said: Said) -> bytes:
        body = said.content.pack("<", said.values, said.tail)
        number = said.content.number
        head = HEADER.pack(number, VERSION, self._sequence, len(body), 0, self._t_s)
        self._sequence = (self._sequence + 1) & 0xFFFF
        whole = head + body
        return cobs_encode(whole + CRC.pack(zlib.crc32(whole))) + b"\0"

    def _take(self, stuffed: bytes) -> FlightAnswer | None:
        frame = cobs_decode(stuffed)
        if frame is None:
            self.faults["corrupt"] += 1
            return None
        if len(frame) < HEADER.size + CRC.size:
            self.faults["cut"] += 1
            return None
        number, version, sequence, size, _, t_s = HEADER.unpack_from(frame)
        body, (crc,) = frame[: -CRC.size], CRC.unpack(frame[-CRC.size :])
        if zlib.crc32(body) != crc:
            self.faults["corrupt"] += 1
        elif size != len(body) - HEADER.size:
            self.faults["wrong_length"] += 1
        elif version != VERSION:
            self.faults["unknown"] += 1
        else:
            if number == HELLO:
                self._numbers.restart()
            if self._numbers.takes(sequence):
                return self._dialogue.take(number, t_s, "<", body[HEADER.size :])
        return None
