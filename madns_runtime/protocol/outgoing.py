"""
The sending half of a link: queues of messages, and the datagrams that carry them.

Everything that says how much, how fast and in what order is decided here; what the header tells of the
other direction comes from `incoming`.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from madns_runtime.errors import MessageTooLarge
from madns_runtime.protocol.counters import ClassCounters, LinkCounters
from madns_runtime.protocol.datagram import (
    ALONE,
    BEST_ALONE,
    BEST_BYTES_MAX,
    FRAME,
    HEADER_REST,
    MAC_BYTES,
    MESSAGE_BYTES_MAX,
    PAYLOAD_BYTES_MAX,
    PROBE,
    Seal,
)
from madns_runtime.protocol.deadlines import DeadlineWatch
from madns_runtime.protocol.incoming import Incoming
from madns_runtime.protocol.link_settings import LinkLimits, SendQueueFull
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.packets import PACE_QUANTUM_S, Packets, TokenBucket
from madns_runtime.protocol.sending import MESSAGES_QUEUED_MAX, Fragment, SendStream

_BEST: Final = int(Service.BEST)
_RELIABLE_BIT: Final = 1 << Service.RELIABLE
_SYNC_BIT: Final = 1 << Service.SYNC
_NEVER: Final = float("inf")


class BestSender:
    """Frames that wait for the next datagram; when the queue is full the oldest gives way."""

    __slots__ = ("_counters", "numbers", "queue")

    def __init__(self, queue_max: int, counters: ClassCounters) -> None:
        self._counters = counters
        self.numbers: dict[int, int] = {}
        """Number of the next message by channel, which is how many there were."""
        self.queue: deque[bytes] = deque(maxlen=queue_max)

    def push(self, body: bytes, channel: int) -> None:
        """
        Queue a message.

        Raises:
            MessageTooLarge: It does not fit one datagram.
        """
        if len(body) > BEST_BYTES_MAX:
            raise MessageTooLarge(
                f"a BEST message must fit one datagram: expected at most {BEST_BYTES_MAX} bytes, "
                f"got {len(body)}; send it RELIABLE or make it smaller"
            )
        if len(self.queue) == self.queue.maxlen:
            self._counters.dropped += 1
        number = self.numbers.get(channel, 0)
        self.numbers[channel] = number + 1
        self.queue.append(FRAME.pack(_BEST, channel, len(body), number) + body)


class Outgoing:
    """
    The sending half of a link.

    Args:
        seal: Closes the datagrams.
        limits: Bounds of the queues, and the pace.
        counters: Where all that is sent is counted.
        packets: Numbers the packets.
        incoming: The other half, which every header acknowledges.
    """

    __slots__ = (
        "_carried",
        "_carrier",
        "_chunks",
        "_contents",
        "_counters",
        "_incoming",
        "_limits",
        "_pacer",
        "_packets",
        "_room",
        "_seal",
        "best",
        "now_s",
        "reliable",
        "streams",
        "sync",
        "watch",
    )

    def __init__(
        self,
        seal: Seal,
        limits: LinkLimits,
        *,
        counters: LinkCounters,
        packets: Packets,
        incoming: Incoming,
    ) -> None:
        self._seal = seal
        self._limits = limits
        self._counters = counters
        self._packets = packets
        self._incoming = incoming
        self._pacer = TokenBucket(limits.pace_bytes_per_s, limits.pace_burst_bytes)
        self.best = BestSender(limits.best_queue_max, counters.best)
        self.reliable = SendStream(Service.RELIABLE, packets.round_trip, counters.reliable)
        self.sync = SendStream(Service.SYNC, packets.round_trip, counters.sync)
        self.streams = (self.reliable, self.sync)
        self.watch = DeadlineWatch(counters)
        self.now_s = -_NEVER
        """Time of the newest call: what is due at once is due then."""
        # The datagram being filled.
        self._chunks: list[bytes] = []
        self._room = PAYLOAD_BYTES_MAX
        self._contents = 0
        self._carried: list[Fragment] = []
        self._carrier: SendStream | None = None

    def check_room(self, stream: SendStream, size: int) -> None:
        """
        Refuse a message of *size* bytes that *stream* must not take, or not now.

        Raises:
            MessageTooLarge: It never will.
            SendQueueFull: It may when the peer has taken what waits.
        """
        limit = self._limits.send_queue_bytes_max
        if size > MESSAGE_BYTES_MAX or size > limit:
            raise MessageTooLarge(
                f"expected a message of at most {min(limit, MESSAGE_BYTES_MAX)} bytes, got {size}; "
                "send it in parts"
            )
        if stream.queued_bytes + size > limit or stream.is_full:
            self._counters.send_queue_full += 1
            raise SendQueueFull(
                f"{stream.queued_bytes} bytes wait for the peer already (at most {limit} bytes and "
                f"{MESSAGES_QUEUED_MAX} messages may); send less, or BEST what may be lost"
            )

    # Datagrams.

    def datagrams_to_send(self, now_s: float) -> list[bytes]:
        """Return what is to be sent now, in this order: acknowledgement, SYNC, BEST, RELIABLE."""
        self.now_s = now_s
        datagrams: list[bytes] = []
        reliable, sync = self.streams
        if sync.queued_bytes and (sync.has_output or sync.is_probe_due):
            self._fill(sync, now_s, datagrams)
        best = self.best.queue
        if best:
            for frame in best:
                if len(frame) > self._room:
                    datagrams.append(self._close(now_s))
                self._chunks.append(frame)
                self._room -= len(frame)
            self._contents |= 1 << _BEST
            best.clear()
        if reliable.queued_bytes and (
            reliable.is_probe_due or (reliable.has_output and now_s >= self._pacer.opens_at_s)
        ):
            if self._carrier is not None:
                datagrams.append(self._close(now_s))
            self._fill(reliable, now_s, datagrams)
        if self._contents or (not datagrams and now_s >= self._packets.ack_due_s):
            datagrams.append(self._close(now_s))
        for stream in self.streams:
            if stream.queued_bytes:
                stream.arm_probe(now_s)
        return datagrams

    def _fill(self, stream: SendStream, now_s: float, datagrams: list[bytes]) -> None:
        """Put all fragments that may go into datagrams; the last one may stay open."""
        pacer = None if stream is self.sync else self._pacer
        bit = _SYNC_BIT if pacer is None else _RELIABLE_BIT
        if stream.is_probe_due:
            stream.is_probe_due = False
            self._contents |= PROBE
        while pacer is None or now_s >= pacer.opens_at_s:
            fragment = stream.take(self._room)
            if fragment is None:
                if not stream.has_output:
                    return
                datagrams.append(self._close(now_s))
                continue
            frame = fragment.frame
            self._chunks.append(frame)
            self._room -= len(frame)
            self._carried.append(fragment)
            self._carrier = stream
            self._contents |= bit
            if pacer is not None:
                pacer.spend(len(frame), now_s)

    def _close(self, now_s: float) -> bytes:
        """Seal the datagram being filled and begin the next."""
        packet_number, largest, ack_bits, delay = self._packets.depart(now_s)
        incoming = self._incoming
        streams = incoming.streams_told or incoming.tell_streams()
        rest = HEADER_REST.pack(packet_number, largest, ack_bits, streams, delay, self._contents, 0)
        datagram = self._seal.close(rest, b"".join(self._chunks))
        self._counters.bytes_sent += len(datagram)
        carrier = self._carrier
        if carrier is not None:
            carrier.record(packet_number, now_s, self._carried)
            self._packets.are_awaited = True
            self._carrier = None
            self._carried = []
        self._chunks.clear()
        self._room = PAYLOAD_BYTES_MAX
        self._contents = 0
        return datagram

    def seal_best(self, body: bytes, now_s: float, *, channel: int) -> bytes | None:
        """
        Return the datagram of a BEST message that leaves at once, as most of a tick's do.

        None, with nothing done, if the message must go through `Link.send`: others wait before it, or
        it is too long.
        """
        best = self.best
        if best.queue or len(body) > BEST_BYTES_MAX:
            return None
        packet_number, largest, ack_bits, delay = self._packets.depart(now_s)
        incoming = self._incoming
        number = best.numbers.get(channel, 0)
        best.numbers[channel] = number + 1
        seal = self._seal
        unsealed = (
            ALONE.pack(
                seal.prefix,
                packet_number,
                largest,
                ack_bits,
                incoming.streams_told or incoming.tell_streams(),
                delay,
                BEST_ALONE,
                0,
                _BEST,
                channel,
                len(body),
                number,
            )
            + body
        )
        counters = self._counters
        counters.bytes_sent += len(unsealed) + MAC_BYTES
        mac = seal.send_mac.copy()
        mac.update(unsealed)
        return unsealed + mac.digest()

    # What the peer says of it.

    def acknowledge(
        self, ack: int, ack_bits: int, streams: tuple[int, int, int, int], now_s: float
    ) -> None:
        """Take the peer's account: packets received, fragments expected next and granted (see STREAMS)."""
        reliable_next, sync_next, reliable_granted, sync_granted = streams
        reliable, sync = self.streams
        reliable.advance(reliable_next, reliable_granted)
        if sync.advance(sync_next, sync_granted):
            self.watch.acknowledge(sync.counters.acknowledged, now_s)
        for stream in self.streams:
            if stream.is_listening:
                stream.acknowledge(ack, ack_bits, now_s)
            stream.arm_probe(now_s)
        self._packets.are_awaited = reliable.is_listening or sync.is_listening

    # Time.

    def get_timer(self) -> float | None:
        """Return when to call `handle_timer` and `datagrams_to_send`, None for never."""
        reliable, sync = self.streams
        if self.best.queue:
            return self.now_s
        times = [self._packets.ack_due_s, self.watch.get_timer()]
        if sync.queued_bytes:
            if sync.has_output or sync.is_probe_due:
                return self.now_s
            times.append(sync.get_timer())
        if reliable.queued_bytes:
            if reliable.is_probe_due:
                return self.now_s
            times.append(reliable.get_timer())
            if reliable.has_output:
                opens_at_s = self._pacer.opens_at_s
                is_open = opens_at_s <= self.now_s
                times.append(self.now_s if is_open else opens_at_s + PACE_QUANTUM_S)
        timer_s = min(times)
        return None if timer_s == _NEVER else timer_s

    def handle_timer(self, now_s: float) -> None:
        """Do what is due by now; `datagrams_to_send` has the outcome."""
        self.now_s = now_s
        for stream in self.streams:
            stream.expire(now_s)
        self.watch.expire(now_s)
