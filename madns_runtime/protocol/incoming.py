"""
The receiving half of a link: packets that are new, frames that may be taken, messages for the owner.

Here are the bounds against a peer that sends more than it was granted.

A stream is messages in order, once each, over datagrams that may not arrive. A sender writes its messages, each
behind a 4-byte prefix, into one stream of bytes and cuts that into numbered fragments, as large as a datagram allows;
small messages share one. The receiver puts the fragments in order and grants how many beyond the next expected one it
is ready to hold. A fragment travels unchanged, but each time in a new packet.

RELIABLE and SYNC have streams and timers of their own and never share a datagram: so what happens to
one is without effect on the other.
"""

from __future__ import annotations

from collections import deque
from hmac import compare_digest
from typing import Final, NamedTuple

from madns_runtime.protocol.counters import ClassCounters, LinkCounters
from madns_runtime.protocol.datagram import (
    ALONE,
    ALONE_AT,
    ALONE_BYTES_MIN,
    BEST_ALONE,
    DATAGRAM_BYTES_MAX,
    FRAME,
    FRAME_BYTES,
    HEADER_BYTES,
    MAC_BYTES,
    MESSAGE_BYTES_MAX,
    MESSAGE_PREFIX,
    STREAMS,
    WINDOW_FRAGMENTS_MIN,
    Seal,
)
from madns_runtime.protocol.link_settings import LinkLimits
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.packets import Packets

Frame = tuple[int, int, int, bytes]
"""Service, channel, number, payload."""

_BEST: Final = int(Service.BEST)
_SYNC: Final = int(Service.SYNC)
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


class BestReceiver:
    """Messages that wait for the owner, and what is missing between them."""

    __slots__ = ("_counters", "newest", "ready")

    def __init__(self, queue_max: int, counters: ClassCounters) -> None:
        self._counters = counters
        self.newest: dict[int, int] = {}
        """Number of the newest message by channel."""
        self.ready: deque[Received] = deque(maxlen=queue_max)

    def accept(self, channel: int, number: int, body: bytes) -> None:
        """Take a message if it is newer than all before it."""
        counters = self._counters
        ahead = number - self.newest.get(channel, -1)
        if ahead <= 0:
            if ahead == 0:
                counters.duplicates += 1
            else:
                # It was counted as lost when a newer one came.
                counters.late += 1
                counters.lost -= 1
            return
        counters.lost += ahead - 1
        counters.received += 1
        self.newest[channel] = number
        if len(self.ready) == self.ready.maxlen:
            counters.dropped += 1
        self.ready.append(Received(Service.BEST, channel, body))


class Incoming:
    """
    The receiving half of a link.

    Args:
        seal: Checks the datagrams of the quick way.
        limits: Bounds of the queues, and the windows granted.
        counters: Where all that is received is counted.
        packets: Knows those that are new, and what the peer's acknowledgements are about.
    """

    __slots__ = (
        "_best",
        "_counters",
        "_packets",
        "_ready",
        "_seal",
        "streams",
        "streams_heard",
        "streams_told",
    )

    def __init__(
        self, seal: Seal, limits: LinkLimits, *, counters: LinkCounters, packets: Packets
    ) -> None:
        self._seal = seal
        self._counters = counters
        self._packets = packets
        self._best = BestReceiver(limits.best_queue_max, counters.best)
        self._ready: deque[Received] = deque()
        reliable_window, sync_window = limits.get_windows()
        self.streams = (
            ReceiveStream(Service.RELIABLE, reliable_window, counters.reliable),
            ReceiveStream(Service.SYNC, sync_window, counters.sync),
        )
        self.streams_heard = b""
        """The peer's view of our streams by its newest header; see STREAMS."""
        self.streams_told = b""
        """Our headers' word on the peer's streams; empty when `tell_streams` must say it anew."""

    def best_reached(self, channel: int) -> int:
        """Return how many BEST messages of a channel the peer had sent with the newest that came."""
        return self._best.newest.get(channel, -1) + 1

    def tell_streams(self) -> bytes:
        """Return how far each stream is and what is granted, for this header and those to come."""
        reliable, sync = self.streams
        reliable.advertised = reliable.limit
        sync.advertised = sync.limit
        self.streams_told = STREAMS.pack(
            reliable.next_expected,
            sync.next_expected,
            reliable.limit - reliable.next_expected,
            sync.limit - sync.next_expected,
        )
        return self.streams_told

    def open_best(self, data: bytes, now_s: float) -> bytes | None:
        """
        Return the body of the one BEST message in a datagram like most of a tick's.

        That is one which follows the newest, says nothing new of either stream and finds none that
        waits for acknowledgements: what `Link.receive_datagram` does for it comes to little. For any
        other datagram None, with nothing done, and `Link.receive_datagram` must have it.
        """
        packets, best = self._packets, self._best
        if packets.are_awaited or best.ready or len(data) < ALONE_BYTES_MIN:
            return None
        (
            prefix,
            packet_number,
            ack,
            _,
            streams,
            ack_delay,
            contents,
            _,
            kind,
            channel,
            size,
            number,
        ) = ALONE.unpack_from(data)
        seal = self._seal
        if (
            prefix != seal.peer_prefix
            or packet_number != packets.largest + 1
            or streams != self.streams_heard
            or contents != BEST_ALONE
            or kind != _BEST
            or size != len(data) - ALONE_BYTES_MIN
            or number != best.newest.get(channel, -1) + 1
            or ack > packets.newest
            or len(data) > DATAGRAM_BYTES_MAX
        ):
            return None
        mac = seal.receive_mac.copy()
        mac.update(data[:-MAC_BYTES])
        if not compare_digest(mac.digest(), data[-MAC_BYTES:]):
            return None
        packets.largest = packet_number  # as `packets.add` does
        packets.largest_at_s = now_s
        counters = self._counters
        counters.datagrams_received += 1
        counters.bytes_received += len(data)
        if now_s >= packets.measure_due_s and ack > packets.acknowledged:
            packets.measure(ack, ack_delay, now_s)
        counters.best.received += 1
        best.newest[channel] = number
        return data[ALONE_AT:-MAC_BYTES]

    def parse(self, data: bytes) -> list[Frame] | None:
        """Return the frames of a datagram, None if any is malformed or was not granted."""
        frames = []
        offset = HEADER_BYTES
        end = len(data) - MAC_BYTES
        while offset < end:
            start = offset + FRAME_BYTES
            if start > end:
                return None
            kind, channel, length, number = FRAME.unpack_from(data, offset)
            offset = start + length
            if offset > end or kind > _SYNC:
                return None
            # A peer that sends beyond what it was granted would make us hold more than we bound.
            if kind and number >= self.streams[kind - 1].limit:
                return None
            frames.append((kind, channel, number, data[start:offset]))
        return frames

    def take(self, frames: list[Frame]) -> None:
        """Take the frames of a new packet."""
        for kind, channel, number, payload in frames:
            if kind:
                self.streams[kind - 1].accept(number, payload, self._ready)
                self.streams_told = b""
            else:
                self._best.accept(channel, number, payload)

    def next_message(self) -> Received | None:
        """Return the next message received, the streams' in their order; None if there is none."""
        if self._ready:
            message = self._ready.popleft()
            self.streams_told = b""
            if self.streams[message.service - 1].deliver():
                self._packets.ack_due_s = self._packets.largest_at_s  # at once
            return message
        best = self._best.ready
        return best.popleft() if best else None
