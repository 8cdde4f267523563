"""
Streams and their receiving half: messages in order, once each, over datagrams that may not arrive.

A sender writes its messages, each behind a 4-byte prefix, into one stream of bytes and cuts that into
numbered fragments, as large as a datagram allows; small messages share one. The receiver puts the
fragments in order and grants how many beyond the next expected one it is ready to hold. A fragment
travels unchanged, but each time in a new packet.

RELIABLE and SYNC have streams and timers of their own and never share a datagram: so what happens to
one is without effect on the other.
"""

from __future__ import annotations

from collections import deque
from struct import Struct
from typing import Final, NamedTuple

from madns_runtime.protocol.counters import ClassCounters
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.seal import PAYLOAD_BYTES_MAX

FRAME: Final = Struct("<BBHQ")
"""service, channel (BEST only), payload bytes, number of the message (BEST) or fragment."""
FRAME_BYTES: Final = FRAME.size
FRAGMENT_BYTES_MAX: Final = PAYLOAD_BYTES_MAX - FRAME_BYTES
MESSAGE_PREFIX: Final = Struct("<I")
"""channel in the upper 8 bits, body length in the lower 24: every value is a valid one."""
MESSAGE_BYTES_MAX: Final = (1 << 24) - 1
CHANNEL_MAX: Final = 255
WINDOW_FRAGMENTS_MIN: Final = 4
"""What every receiver grants from the start, before its first datagram has come."""
WINDOW_FRAGMENTS_MAX: Final = 0xFFFF

_PREFIX_BYTES: Final = MESSAGE_PREFIX.size


class Received(NamedTuple):
    """A message as the link hands it over."""

    service: Service
    channel: int
    body: bytes


class ReceiveStream:
    """
    The receiving half of a stream.

    It holds at most the window in fragments out of order, one unfinished message, and what the owner
    has not taken; while the owner leaves finished messages lying, nothing more is granted.
    """

    __slots__ = (
        "_assembly",
        "_counters",
        "_held",
        "_service",
        "_undelivered",
        "advertised",
        "limit",
        "next_expected",
        "window",
    )

    def __init__(self, service: Service, window: int, counters: ClassCounters) -> None:
        self._service = service
        self._counters = counters
        self.window = window
        """Fragments."""
        self.next_expected = 0
        self.limit = window
        """Fragments below this are granted."""
        self.advertised = WINDOW_FRAGMENTS_MIN
        """The limit that the newest datagram told the peer."""
        self._held: dict[int, bytes] = {}
        self._assembly = bytearray()
        self._undelivered = 0

    @property
    def held_bytes(self) -> int:
        """Memory that fragments and unfinished messages take, without what waits for the owner."""
        return len(self._assembly) + sum(map(len, self._held.values()))

    def accept(self, number: int, data: bytes, ready: deque[Received]) -> None:
        """Take a fragment below `limit` and append the messages that it completes to *ready*."""
        expected = self.next_expected
        held = self._held
        if number != expected:
            if number < expected or number in held:
                self._counters.duplicates += 1
            else:
                held[number] = data
            return
        self._feed(data, ready)
        expected += 1
        while held and expected in held:
            self._feed(held.pop(expected), ready)
            expected += 1
        self.next_expected = expected
        if not self._undelivered:
            self.limit = expected + self.window

    def _feed(self, data: bytes, ready: deque[Received]) -> None:
        assembly = self._assembly
        if not assembly and len(data) >= _PREFIX_BYTES:
            (word,) = MESSAGE_PREFIX.unpack_from(data)
            if (word & MESSAGE_BYTES_MAX) + _PREFIX_BYTES == len(data):
                # The usual case, one whole short message.
                ready.append(Received(self._service, word >> 24, data[_PREFIX_BYTES:]))
                self._undelivered += 1
                self._counters.received += 1
                return
        assembly += data
        offset = 0
        size = len(assembly)
        while size - offset >= _PREFIX_BYTES:
            (word,) = MESSAGE_PREFIX.unpack_from(assembly, offset)
            start = offset + _PREFIX_BYTES
            end = start + (word & MESSAGE_BYTES_MAX)
            if end > size:
                break
            ready.append(Received(self._service, word >> 24, bytes(assembly[start:end])))
            self._undelivered += 1
            self._counters.received += 1
            offset = end
        del assembly[:offset]

    def deliver(self) -> bool:
        """
        Note that the owner took a message.

        Returns:
            Whether so much more is granted now that the peer should hear of it.
        """
        self._undelivered -= 1
        if self._undelivered:
            return False
        self.limit = self.next_expected + self.window
        return (self.limit - self.advertised) * 2 >= self.window
