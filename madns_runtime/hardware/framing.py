"""
Frames in a stream of bytes, as serial devices send them. Pure: bytes in, frames out, nothing is kept beyond a bound.

What belongs to no whole, valid frame is thrown away and counted, byte by byte: a line full of garbage costs
time, never memory, and the next good frame is found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, Literal

from madns_runtime.errors import PluginError

Framing = Literal["lines", "nmea", "ubx", "cobs", "length_prefixed", "raw"]

UBX_SYNC: Final = b"\xb5\x62"
UBX_HEAD_BYTES: Final = 6
UBX_CHECKSUM_BYTES: Final = 2
NMEA_CHECKSUM_DIGITS: Final = 2
NMEA_RESERVED: Final = b"$*\r\n"
"""Bytes that begin a sentence, its checksum and its end."""
SHOWN_BYTES_MAX: Final = 60
"""Of a frame that is refused."""


class Framer:
    """
    Cuts a stream into frames, and wraps what is sent.

    Args:
        frame_bytes_max: A longer frame is none.
    """

    def __init__(self, frame_bytes_max: int = 1024) -> None:
        self._max = frame_bytes_max
        self._buffer = bytearray()
        self.garbage_bytes = 0
        """Bytes that belonged to no frame."""
        self.bad_checksums = 0
        """Frames whose checksum was wrong."""

    @property
    def waiting_bytes(self) -> int:
        """Bytes of a frame whose rest has not come."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[bytes]:
        """Take what came, and return the frames that are whole now."""
        self._buffer += data
        frames = []
        while (cut := self._cut(self._buffer)) is not None:
            frame, used = cut
            del self._buffer[:used]
            if frame is not None:
                frames.append(frame)
        return frames

    def wrap(self, frame: bytes) -> bytes:
        """Return the bytes that carry a frame."""
        return frame

    def _cut(self, buffer: bytearray) -> tuple[bytes | None, int] | None:
        """Return a frame, or None for garbage, and how many bytes it takes; None if more must come first."""
        used = min(len(buffer), self._max)
        return (bytes(buffer[:used]), used) if used else None

    def _garbage(self, count: int) -> tuple[None, int]:
        self.garbage_bytes += count
        return None, count


class EndedFramer(Framer):
    """Frames that end with a byte which is in none; of one that is too long the rest is thrown away as well."""

    end_byte = b"\n"
    _is_skipping = False
    """Whether the beginning of a frame that is too long was thrown away, and its end has not come."""

    def _cut_to_end(self, buffer: bytearray, longest: int) -> int | tuple[None, int] | None:
        """Return where the next frame's end is; garbage of one longer than *longest*; None if more must come first."""
        end = buffer.find(self.end_byte)
        if end < 0:
            if not buffer or not (self._is_skipping or len(buffer) > longest):
                return None
            self._is_skipping = True
            return self._garbage(len(buffer))
        if self._is_skipping or end > longest:
            self._is_skipping = False
            return self._garbage(end + 1)
        return end


class LineFramer(EndedFramer):
    """Lines that end with a line feed; a carriage return before it is left out."""

    overhead_bytes = 1
    """Beside the frame, on the line before its line feed."""

    def wrap(self, frame: bytes) -> bytes:
        """
        Return the line with carriage return and line feed; a line end that it brings along is its own.

        Raises:
            PluginError: It would be several lines.
        """
        line = frame[:-1].removesuffix(b"\r") if frame.endswith(b"\n") else frame
        if b"\n" in line:
            raise PluginError(
                f"expected one line, got {1 + line.count(10)}: {frame[:SHOWN_BYTES_MAX]!r}; write each by itself, or use"
                " framing: raw"
            )
        return line + b"\r\n"

    def _cut(self, buffer: bytearray) -> tuple[bytes | None, int] | None:
        end = self._cut_to_end(buffer, self._max + self.overhead_bytes)
        if not isinstance(end, int):
            return end
        line = bytes(buffer[:end]).removesuffix(b"\r")
        if not line:
            return None, end + 1
        frame, used = self._checked(line, end + 1)
        # Without its carriage return a line may be longer than one with it.
        return (
            self._garbage(used) if frame is not None and len(frame) > self._max else (frame, used)
        )

    def _checked(self, line: bytes, used: int) -> tuple[bytes | None, int]:
        return line, used


class NmeaFramer(LineFramer):
    """Sentences of NMEA 0183, $...*hh: given and taken without $ and checksum."""

    overhead_bytes = len("$*hh\r")

    def wrap(self, frame: bytes) -> bytes:
        """
        Return the sentence with its $, checksum and line end.

        Raises:
            PluginError: It holds what begins or ends a sentence.
        """
        if any(byte in frame for byte in NMEA_RESERVED):
            raise PluginError(
                f"expected a sentence without $, checksum and line end, which it is given; got {frame[:SHOWN_BYTES_MAX]!r}"
            )
        return b"$%b*%02X\r\n" % (frame, _xor(frame))

    def _checked(self, line: bytes, used: int) -> tuple[bytes | None, int]:
        start = line.rfind(b"$")
        body, star, digits = line[start + 1 :].rpartition(b"*")
        if start < 0 or not star or len(digits) != NMEA_CHECKSUM_DIGITS:
            return self._garbage(used)
        self.garbage_bytes += start
        try:
            is_right = digits.isalnum() and int(digits, 16) == _xor(body)  # " 5" is a number, too
        except ValueError:
            is_right = False
        if not is_right:
            self.bad_checksums += 1
            return None, used
        return body, used


class UbxFramer(Framer):
    """Messages of u-blox receivers: given and taken as class, number and payload, without sync, length, checksum."""

    def wrap(self, frame: bytes) -> bytes:
        """
        Return the message with sync characters, length and checksum.

        Raises:
            PluginError: It has not even class and number.
        """
        if len(frame) < 2:
            raise PluginError(f"expected class, number and payload of a message, got {frame!r}")
        body = frame[:2] + (len(frame) - 2).to_bytes(2, "little") + frame[2:]
        return UBX_SYNC + body + _fletcher(body)

    def _cut(self, buffer: bytearray) -> tuple[bytes | None, int] | None:
        start = buffer.find(UBX_SYNC)
        if start:
            if start < 0:
                # The last byte may be the first of the next sync.
                start = len(buffer) - (buffer[-1:] == UBX_SYNC[:1])
            return self._garbage(start) if start else None
        if len(buffer) < UBX_HEAD_BYTES:
            return None
        length = int.from_bytes(buffer[4:6], "little")
        if length + 2 > self._max:
            return self._garbage(len(UBX_SYNC))
        used = UBX_HEAD_BYTES + length + UBX_CHECKSUM_BYTES
        if len(buffer) < used:
            return None
        body = bytes(buffer[2 : used - UBX_CHECKSUM_BYTES])
        if _fletcher(body) != buffer[used - UBX_CHECKSUM_BYTES : used]:
            self.bad_checksums += 1
            return self._garbage(len(UBX_SYNC))
        return body[:2] + body[4:], used


class CobsFramer(EndedFramer):
    """Frames without a zero byte, by consistent overhead byte stuffing, each ended by one (Cheshire and Baker, 1999)."""

    end_byte = b"\0"

    def wrap(self, frame: bytes) -> bytes:
        """Return the frame stuffed, with its end."""
        return cobs_encode(frame) + b"\0"

    def _cut(self, buffer: bytearray) -> tuple[bytes | None, int] | None:
        end = self._cut_to_end(buffer, self._max + self._max // 254 + 2)
        if not isinstance(end, int):
            return end
        if end == 0:
            return None, 1  # zeros between frames are no garbage
        frame = cobs_decode(bytes(buffer[:end]))
        if frame is None or len(frame) > self._max:
            return self._garbage(end + 1)
        return frame, end + 1


class LengthFramer(Framer):
    """
    Frames behind their length, of a few bytes.

    Args:
        frame_bytes_max: A longer frame is none.
        length_bytes: Bytes of the length.
        order: Which of them comes first.
    """

    def __init__(
        self,
        frame_bytes_max: int = 1024,
        length_bytes: int = 2,
        order: Literal["little", "big"] = "little",
    ) -> None:
        super().__init__(frame_bytes_max)
        self._length_bytes = length_bytes
        self._order: Literal["little", "big"] = order

    def wrap(self, frame: bytes) -> bytes:
        """
        Return the frame behind its length.

        Raises:
            PluginError: The length cannot tell so many bytes.
        """
        if len(frame) >= 1 << 8 * self._length_bytes:
            raise PluginError(
                f"expected at most {(1 << 8 * self._length_bytes) - 1} bytes, got {len(frame)}"
            )
        return len(frame).to_bytes(self._length_bytes, self._order) + frame

    def _cut(self, buffer: bytearray) -> tuple[bytes | None, int] | None:
        head = self._length_bytes
        if len(buffer) < head:
            return None
        length = int.from_bytes(buffer[:head], self._order)
        if length > self._max:
            return self._garbage(1)  # lost step: look for a length one byte on
        if not length:
            return None, head  # a frame of nothing, as some send to say that they are there
        if len(buffer) < head + length:
            return None
        return bytes(buffer[head : head + length]), head + length


FRAMERS: Final[Mapping[Framing, Callable[[int], Framer]]] = {
    "lines": LineFramer,
    "nmea": NmeaFramer,
    "ubx": UbxFramer,
    "cobs": CobsFramer,
    "length_prefixed": LengthFramer,
    "raw": Framer,
}


def make_framer(
    framing: Framing,
    frame_bytes_max: int,
    length_bytes: int,
    length_order: Literal["little", "big"],
) -> Framer:
    """Return what cuts and wraps; the length's bytes and their order are those of `length_prefixed`."""
    if framing == "length_prefixed":
        return LengthFramer(frame_bytes_max, length_bytes, length_order)
    return FRAMERS[framing](frame_bytes_max)


def cobs_encode(data: bytes) -> bytes:
    """Return *data* without zero bytes."""
    out = bytearray()
    for block in data.split(b"\0"):
        while len(block) >= 254:
            out += b"\xff" + block[:254]
            block = block[254:]
        out.append(len(block) + 1)
        out += block
    return bytes(out)


def cobs_decode(data: bytes) -> bytes | None:
    """Return what was encoded; None if that cannot be."""
    out = bytearray()
    place = 0
    while place < len(data):
        code = data[place]
        block = data[place + 1 : place + code]
        if code == 0 or len(block) != code - 1:
            return None
        out += block
        place += code
        if code < 255 and place < len(data):
            out.append(0)
    return bytes(out)


def _xor(data: bytes) -> int:
    result = 0
    for byte in data:
        result ^= byte
    return result


def _fletcher(data: bytes) -> bytes:
    """Return the checksum of u-blox messages (8-bit Fletcher, RFC 1145)."""
    a = b = 0
    for byte in data:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))
