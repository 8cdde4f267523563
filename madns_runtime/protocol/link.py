"""
One peer's conversation: messages in, datagrams out, and the other way round.

The owner moves the datagrams and keeps the time:

    link.receive_datagram(data, now_s)        for what the socket gave; then
    link.next_message()                       until None
    link.handle_timer(now_s)                  when `get_timer()` has come
    link.datagrams_to_send(now_s)             after any of these and after `send`

Both sides use the same class. Nothing here gives a peer up: the owner decides that by its silence.
"""

from __future__ import annotations

from collections import deque
from hmac import compare_digest
from struct import Struct
from typing import Final

from madns_runtime.errors import MessageTooLarge
from madns_runtime.protocol.acks import ReceivedPackets
from madns_runtime.protocol.best import BEST_BYTES_MAX, BestReceiver, BestSender
from madns_runtime.protocol.counters import LinkCounters
from madns_runtime.protocol.deadlines import BrokenDeadline, DeadlineWatch
from madns_runtime.protocol.delivery import (
    CHANNEL_MAX,
    FRAME,
    FRAME_BYTES,
    MESSAGE_BYTES_MAX,
    Received,
    ReceiveStream,
)
from madns_runtime.protocol.limits import LinkLimits, SendQueueFull
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.recovery import (
    ACK_DELAY_UNIT_S,
    ACK_DELAY_UNITS_MAX,
    MEASURE_INTERVAL_S,
    PACE_QUANTUM_S,
    Pacer,
    RoundTrip,
)
from madns_runtime.protocol.seal import (
    DATAGRAM_BYTES_MAX,
    HEADER_BYTES,
    MAC_BYTES,
    PAYLOAD_BYTES_MAX,
    PREFIX_BYTES,
    Role,
    Seal,
    derive_keys,
)
from madns_runtime.protocol.sending import MESSAGES_QUEUED_MAX, Fragment, SendStream

__all__ = [
    "BEST_BYTES_MAX",
    "MESSAGE_BYTES_MAX",
    "BrokenDeadline",
    "Link",
    "LinkLimits",
    "Received",
    "SendQueueFull",
]

_BEST: Final = int(Service.BEST)
_SYNC: Final = int(Service.SYNC)
_PROBE: Final = 8  # contents bit beside 1 << service
_ELICITING: Final = 1 << Service.RELIABLE | 1 << Service.SYNC | _PROBE
_AT_ONCE: Final = 1 << Service.SYNC | _PROBE
_SENT_TIMES: Final = 256
_NEVER: Final = float("inf")
_BEST_ALONE: Final = 1 << Service.BEST
_STREAMS: Final = Struct("<QQHH")
"""What a header says of the streams: how far they are, and what is granted."""
_REST: Final = Struct(f"<QQQ{_STREAMS.size}sHBB")
"""REST with _STREAMS in one piece: from one datagram to the next it is the same, unless a stream moves."""
_ALONE: Final = Struct(f"<{PREFIX_BYTES}s{_REST.format[1:]}{FRAME.format[1:]}")
"""A whole header and that of the one frame behind it."""
_ALONE_AT: Final = HEADER_BYTES + FRAME_BYTES
_ALONE_BYTES_MIN: Final = _ALONE_AT + MAC_BYTES


class Link:
    """One peer's conversation."""

    __slots__ = (
        "_ack_seen",
        "_best_in",
        "_best_out",
        "_carried",
        "_carrier",
        "_chunks",
        "_contents",
        "_in",
        "_is_listening",
        "_limits",
        "_measure_due_s",
        "_now_s",
        "_out",
        "_pacer",
        "_packet_number",
        "_packets",
        "_ready",
        "_room",
        "_round_trip",
        "_seal",
        "_sent_times",
        "_streams_heard",
        "_streams_told",
        "_watch",
        "counters",
        "last_received_s",
    )

    def __init__(self, *, seal: Seal, limits: LinkLimits = LinkLimits()) -> None:  # noqa: B008 - frozen
        self._seal = seal
        self._limits = limits
        self.counters = counters = LinkCounters()
        self.last_received_s: float | None = None
        """When the peer's newest datagram was accepted; None before the first."""
        self._round_trip = RoundTrip()
        self._pacer = Pacer(limits.pace_bytes_per_s, limits.pace_burst_bytes)
        self._watch = DeadlineWatch(counters)
        reliable_window, sync_window = limits.get_windows()
        self._out = (
            SendStream(Service.RELIABLE, self._round_trip, counters.reliable),
            SendStream(Service.SYNC, self._round_trip, counters.sync),
        )
        self._in = (
            ReceiveStream(Service.RELIABLE, reliable_window, counters.reliable),
            ReceiveStream(Service.SYNC, sync_window, counters.sync),
        )
        self._ready: deque[Received] = deque()
        self._best_out = BestSender(limits.best_queue_max, counters.best)
        self._best_in = BestReceiver(limits.best_queue_max, counters.best)
        self._now_s = -_NEVER
        self._packet_number = 0
        self._sent_times = [-_NEVER] * _SENT_TIMES  # of the newest packets, by number
        self._ack_seen = 0
        self._packets = ReceivedPackets()
        # What `open_best` may rely on; the long way keeps it up to date.
        self._streams_heard = b""
        self._streams_told = b""
        self._is_listening = False
        self._measure_due_s = -_NEVER
        # The datagram being filled.
        self._chunks: list[bytes] = []
        self._room = PAYLOAD_BYTES_MAX
        self._contents = 0
        self._carried: list[Fragment] = []
        self._carrier: SendStream | None = None

    @classmethod
    def for_agent(
        cls,
        run_key: bytes,
        session: bytes,
        agent_index: int,
        incarnation: int,
        *,
        limits: LinkLimits = LinkLimits(),  # noqa: B008 - frozen
    ) -> Link:
        """Return the agent's end of a conversation; see `seal.derive_keys` for the arguments."""
        return cls(
            seal=_seal(run_key, session, agent_index, incarnation, Role.AGENT), limits=limits
        )

    @classmethod
    def for_host(
        cls,
        run_key: bytes,
        session: bytes,
        agent_index: int,
        incarnation: int,
        *,
        limits: LinkLimits = LinkLimits(),  # noqa: B008 - frozen
    ) -> Link:
        """Return the host's end of a conversation; see `seal.derive_keys` for the arguments."""
        return cls(seal=_seal(run_key, session, agent_index, incarnation, Role.HOST), limits=limits)

    # What the owner asks.

    @property
    def srtt_s(self) -> float | None:
        """Smoothed round trip, s, without the peer's delay; None before the first."""
        return self._round_trip.srtt_s

    @property
    def is_flushed(self) -> bool:
        """Whether nothing reliable is queued or unacknowledged."""
        return self._out[0].is_flushed and self._out[1].is_flushed

    @property
    def queued_bytes(self) -> int:
        """Bytes of both streams that wait or are not acknowledged."""
        return self._out[0].queued_bytes + self._out[1].queued_bytes

    @property
    def held_bytes(self) -> int:
        """Bytes of both streams received and not finished to messages."""
        return self._in[0].held_bytes + self._in[1].held_bytes

    @property
    def peer_prefix(self) -> bytes:
        """The first bytes of every datagram from this peer: a key to find the link by."""
        return self._seal.peer_prefix

    # Sending.

    def send(
        self,
        body: bytes,
        service: Service,
        now_s: float,
        *,
        channel: int = 0,
        deadline_s: float | None = None,
    ) -> None:
        """
        Queue a message.

        Args:
            body: The message.
            service: Its class of service.
            now_s: This side's monotonic time.
            channel: 0 to 255; of BEST messages the newest of each channel wins, the streams carry it.
            deadline_s: SYNC only: by when the acknowledgement must be here, on the clock of *now_s*.

        Raises:
            MessageTooLarge: BEST messages must fit one datagram (BEST_BYTES_MAX), others MESSAGE_BYTES_MAX.
            SendQueueFull: The stream's queue has no room left for it.
            ValueError: The channel is out of bounds.
        """
        self._now_s = now_s
        if not 0 <= channel <= CHANNEL_MAX:
            raise ValueError(f"expected a channel of 0 to {CHANNEL_MAX}, got {channel}")
        if service == _BEST:
            self._best_out.push(body, channel)
            return
        stream = self._out[service - 1]
        self._check_queue(stream, len(body))
        if deadline_s is not None and service == _SYNC:
            self._watch.add(stream.counters.sent, deadline_s, now_s, (channel, body))
        stream.push(body, channel)

    def send_urgent(self, body: bytes, service: Service, now_s: float) -> None:
        """Queue one of the framework's own few words, also in a stream whose queue is full."""
        self._now_s = now_s
        if service == _BEST:
            self._best_out.push(body, 0)
        else:
            self._out[service - 1].push(body, 0)

    def _check_queue(self, stream: SendStream, size: int) -> None:
        limit = self._limits.send_queue_bytes_max
        if size > MESSAGE_BYTES_MAX or size > limit:
            raise MessageTooLarge(
                f"expected a message of at most {min(limit, MESSAGE_BYTES_MAX)} bytes, got {size}; "
                "send it in parts"
            )
        if stream.queued_bytes + size > limit or stream.is_full:
            self.counters.send_queue_full += 1
            raise SendQueueFull(
                f"{stream.queued_bytes} bytes wait for the peer already (at most {limit} bytes and "
                f"{MESSAGES_QUEUED_MAX} messages may); send less, or BEST what may be lost"
            )

    def datagrams_to_send(self, now_s: float) -> list[bytes]:
        """Return what is to be sent now, in this order: acknowledgement, SYNC, BEST, RELIABLE."""
        self._now_s = now_s
        datagrams: list[bytes] = []
        reliable, sync = self._out
        if sync.has_output or sync.is_probe_due:
            self._fill(sync, now_s, datagrams)
        best = self._best_out.queue
        if best:
            for frame in best:
                if len(frame) > self._room:
                    datagrams.append(self._close(now_s))
                self._chunks.append(frame)
                self._room -= len(frame)
            self._contents |= 1 << _BEST
            best.clear()
        if reliable.is_probe_due or (reliable.has_output and now_s >= self._pacer.opens_at_s):
            if self._carrier is not None:
                datagrams.append(self._close(now_s))
            self._fill(reliable, now_s, datagrams)
        if self._contents or (not datagrams and now_s >= self._packets.ack_due_s):
            datagrams.append(self._close(now_s))
        reliable.arm_probe(now_s)
        sync.arm_probe(now_s)
        return datagrams

    def _fill(self, stream: SendStream, now_s: float, datagrams: list[bytes]) -> None:
        """Put all fragments that may go into datagrams; the last one may stay open."""
        pacer = None if stream is self._out[1] else self._pacer
        bit = 1 << (1 if pacer else _SYNC)
        if stream.is_probe_due:
            stream.is_probe_due = False
            self._contents |= _PROBE
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
        datagram = self._seal_packet(b"".join(self._chunks), self._contents, now_s)
        carrier = self._carrier
        if carrier is not None:
            carrier.record(self._packet_number, now_s, self._carried)
            self._is_listening = True
            self._carrier = None
            self._carried = []
        self._chunks.clear()
        self._room = PAYLOAD_BYTES_MAX
        self._contents = 0
        return datagram

    def _seal_packet(self, payload: bytes, contents: int, now_s: float) -> bytes:
        """Return the next packet: *payload* behind a header with all acknowledgements, sealed."""
        packet_number = self._packet_number + 1
        self._packet_number = packet_number
        largest, ack_bits, delay = self._packets.acknowledge(now_s)
        streams = self._streams_told or self._tell_streams()
        rest = _REST.pack(packet_number, largest, ack_bits, streams, delay, contents, 0)
        datagram = self._seal.close(rest, payload)
        self._sent_times[packet_number % _SENT_TIMES] = now_s
        counters = self.counters
        counters.datagrams_sent += 1
        counters.bytes_sent += len(datagram)
        return datagram

    def _tell_streams(self) -> bytes:
        """Return how far each stream is and what is granted, for this header and those to come."""
        reliable, sync = self._in
        reliable.advertised = reliable.limit
        sync.advertised = sync.limit
        self._streams_told = _STREAMS.pack(
            reliable.next_expected,
            sync.next_expected,
            reliable.limit - reliable.next_expected,
            sync.limit - sync.next_expected,
        )
        return self._streams_told

    def seal_best(self, body: bytes, now_s: float, *, channel: int) -> bytes | None:
        """
        Return the datagram of a BEST message that leaves at once, as most of a tick's do.

        None, with nothing done, if the message must go through `send`: others wait before it, or it
        is too long.
        """
        best = self._best_out
        if best.queue or len(body) > BEST_BYTES_MAX:
            return None
        self._packet_number = packet_number = self._packet_number + 1
        largest, ack_bits, delay = self._packets.acknowledge(now_s)
        number = best.numbers.get(channel, 0)
        best.numbers[channel] = number + 1
        seal = self._seal
        unsealed = (
            _ALONE.pack(
                seal.prefix,
                packet_number,
                largest,
                ack_bits,
                self._streams_told or self._tell_streams(),
                delay,
                _BEST_ALONE,
                0,
                _BEST,
                channel,
                len(body),
                number,
            )
            + body
        )
        self._sent_times[packet_number % _SENT_TIMES] = now_s
        counters = self.counters
        counters.best.sent += 1
        counters.datagrams_sent += 1
        counters.bytes_sent += len(unsealed) + MAC_BYTES
        mac = seal.send_mac.copy()
        mac.update(unsealed)
        return unsealed + mac.digest()

    # Receiving.

    def open_best(self, data: bytes, now_s: float) -> bytes | None:
        """
        Return the body of the one BEST message in a datagram like most of a tick's.

        That is one which follows the newest, says nothing new of either stream and finds none that
        waits for acknowledgements: what `receive_datagram` does for it comes to little. For any
        other datagram None, with nothing done, and `receive_datagram` must have it.
        """
        packets, best = self._packets, self._best_in
        if self._is_listening or best.ready or len(data) < _ALONE_BYTES_MIN:
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
        ) = _ALONE.unpack_from(data)
        seal = self._seal
        if (
            prefix != seal.peer_prefix
            or packet_number != packets.largest + 1
            or streams != self._streams_heard
            or contents != _BEST_ALONE
            or kind != _BEST
            or size != len(data) - _ALONE_BYTES_MIN
            or number != best.newest.get(channel, -1) + 1
            or ack > self._packet_number
            or len(data) > DATAGRAM_BYTES_MAX
        ):
            return None
        mac = seal.receive_mac.copy()
        mac.update(data[:-MAC_BYTES])
        if not compare_digest(mac.digest(), data[-MAC_BYTES:]):
            return None
        packets.add(packet_number, now_s)
        self._now_s = self.last_received_s = now_s
        counters = self.counters
        counters.datagrams_received += 1
        counters.bytes_received += len(data)
        if now_s >= self._measure_due_s and ack > self._ack_seen:
            self._measure(ack, ack_delay, now_s)
        counters.best.received += 1
        best.newest[channel] = number
        return data[_ALONE_AT:-MAC_BYTES]

    def receive_datagram(self, data: bytes, now_s: float) -> bool:
        """
        Take a datagram.

        Returns:
            False if it was refused and counted: not from this peer, changed, repeated or malformed.
        """
        self._now_s = now_s
        fault = self._seal.find_fault(data) or self._accept(data, now_s)
        if fault is None:
            return True
        self.counters.refused[fault] += 1
        return False

    def _accept(self, data: bytes, now_s: float) -> str | None:
        """Take a datagram that is the peer's; return why not, if not, having changed nothing."""
        (
            packet_number,
            ack,
            ack_bits,
            streams,
            ack_delay,
            contents,
            _,
        ) = _REST.unpack_from(data, PREFIX_BYTES)
        reliable_next, sync_next, reliable_granted, sync_granted = _STREAMS.unpack(streams)
        packets = self._packets
        if not packets.is_new(packet_number):
            return "replay"
        reliable, sync = self._out
        if (
            ack > self._packet_number
            or reliable_next > reliable.next_number
            or sync_next > sync.next_number
        ):
            return "malformed"
        frames = self._parse(data)
        if frames is None:
            return "malformed"

        is_in_order = packets.add(packet_number, now_s)
        self.last_received_s = now_s
        counters = self.counters
        counters.datagrams_received += 1
        counters.bytes_received += len(data)
        if ack > self._ack_seen:
            self._measure(ack, ack_delay, now_s)
        reliable.advance(reliable_next, reliable_granted)
        if sync.advance(sync_next, sync_granted):
            self._watch.acknowledge(counters.sync.acknowledged, now_s)
        for stream in self._out:
            if stream.is_listening:
                stream.acknowledge(ack, ack_bits, now_s)
            stream.arm_probe(now_s)
        if contents & _ELICITING:
            packets.owe_ack(now_s, at_once=not is_in_order or bool(contents & _AT_ONCE))
        self._streams_heard = streams
        self._is_listening = reliable.is_listening or sync.is_listening
        for kind, channel, number, payload in frames:
            if kind:
                self._in[kind - 1].accept(number, payload, self._ready)
                self._streams_told = b""
            else:
                self._best_in.accept(channel, number, payload)
        return None

    def _parse(self, data: bytes) -> list[tuple[int, int, int, bytes]] | None:
        """Return the frames (service, channel, number, payload), None if any is malformed."""
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
            if kind and number >= self._in[kind - 1].limit:
                return None
            frames.append((kind, channel, number, data[start:offset]))
        return frames

    def _measure(self, ack: int, ack_delay: int, now_s: float) -> None:
        """Take a round trip from the newest packet acknowledged."""
        self._ack_seen = ack
        self._measure_due_s = now_s + MEASURE_INTERVAL_S
        if ack_delay < ACK_DELAY_UNITS_MAX and self._packet_number - ack < _SENT_TIMES:
            sample_s = now_s - self._sent_times[ack % _SENT_TIMES] - ack_delay * ACK_DELAY_UNIT_S
            self._round_trip.add(sample_s if sample_s > 0 else 0.0)

    def next_message(self) -> Received | None:
        """Return the next message received, the streams' in their order; None if there is none."""
        if self._ready:
            message = self._ready.popleft()
            self._streams_told = b""
            if self._in[message.service - 1].deliver():
                self._packets.ack_due_s = self._now_s
            return message
        best = self._best_in.ready
        return best.popleft() if best else None

    # Time.

    def get_timer(self) -> float | None:
        """Return when to call `handle_timer` and `datagrams_to_send`, None for never."""
        reliable, sync = self._out
        if self._best_out.queue or sync.has_output or sync.is_probe_due or reliable.is_probe_due:
            return self._now_s
        timer_s = min(
            self._packets.ack_due_s,
            reliable.get_timer(),
            sync.get_timer(),
            self._watch.get_timer(),
        )
        if reliable.has_output:
            opens_at_s = self._pacer.opens_at_s
            timer_s = min(
                timer_s, self._now_s if opens_at_s <= self._now_s else opens_at_s + PACE_QUANTUM_S
            )
        return None if timer_s == _NEVER else timer_s

    def handle_timer(self, now_s: float) -> None:
        """Do what is due by now; `datagrams_to_send` has the outcome."""
        self._now_s = now_s
        for stream in self._out:
            stream.expire(now_s)
        self._watch.expire(now_s)

    def next_broken_deadline(self) -> BrokenDeadline | None:
        """Return the next SYNC message that broke its deadline, each once."""
        return self._watch.next_broken()

    def abandon(self, *services: Service) -> None:
        """
        Give streams up, all without an argument: what is not acknowledged is counted as lost and forgotten.

        Nothing can be sent in such a stream again: its receiver waits for what is gone.
        """
        for service in services or (Service.RELIABLE, Service.SYNC):
            self._out[service - 1].abandon()


def _seal(run_key: bytes, session: bytes, agent_index: int, incarnation: int, role: Role) -> Seal:
    keys = derive_keys(run_key, session, agent_index, incarnation)
    return Seal(keys, role, session=session, agent_index=agent_index, incarnation=incarnation)
