"""
What a link receives: packets that are new, frames that may be taken, messages for the owner.

Here are the bounds against a peer that sends more than it was granted.
"""

from __future__ import annotations

from collections import deque
from hmac import compare_digest
from typing import Final

from madns_runtime.protocol.best import BestReceiver
from madns_runtime.protocol.counters import LinkCounters
from madns_runtime.protocol.datagram import (
    ALONE,
    ALONE_AT,
    ALONE_BYTES_MIN,
    BEST_ALONE,
    STREAMS,
)
from madns_runtime.protocol.delivery import FRAME, FRAME_BYTES, Received, ReceiveStream
from madns_runtime.protocol.limits import LinkLimits
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.packets import Packets
from madns_runtime.protocol.seal import DATAGRAM_BYTES_MAX, HEADER_BYTES, MAC_BYTES, Seal

Frame = tuple[int, int, int, bytes]
"""Service, channel, number, payload."""

_BEST: Final = int(Service.BEST)
_SYNC: Final = int(Service.SYNC)


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
        """What the newest header said of the peer's view of our streams; see STREAMS."""
        self.streams_told = b""
        """What our headers say of the peer's streams; empty when `tell_streams` must say it anew."""

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
