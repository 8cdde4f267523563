"""
The sending half of a stream: cuts messages into fragments and sends again what was lost.

See incoming.py for the other half and for what a stream is. When a packet is lost: packets.py.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from madns_runtime.protocol.counters import ClassCounters
from madns_runtime.protocol.datagram import FRAME, FRAME_BYTES, MESSAGE_PREFIX, WINDOW_FRAGMENTS_MIN
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.packets import ACK_BITS, REORDER_PACKETS, RoundTrip

FRAGMENT_BYTES_MIN: Final = 256
"""A long message does not start in less room than this: a new datagram is cheaper."""
MESSAGES_QUEUED_MAX: Final = 65_536
"""Bound of the messages waiting in one stream: short ones cost more than their bytes."""
FAST_RESENDS_MAX: Final = 3
"""A fragment sent again more often than this waits longer each time, whatever later packets arrive: it may
be the path that takes no large datagrams."""
LOST_PACKETS_MAX: Final = 128
"""Lost packets remembered, to notice that they were not lost."""

_PREFIX_BYTES: Final = MESSAGE_PREFIX.size
_NEVER: Final = float("inf")


class Fragment:
    """A piece of a stream with its frame header, and the packet that carried it last."""

    __slots__ = ("frame", "is_acknowledged", "number", "packet", "resends")

    def __init__(self, number: int, frame: bytes) -> None:
        self.number = number
        self.frame = frame
        self.packet = 0
        self.resends = 0
        self.is_acknowledged = False


class Packet(NamedTuple):
    """Fragments sent together: when, and from when on they may be held to be lost."""

    sent_s: float
    fragments: list[Fragment]
    kept_until_s: float


class SendStream:
    """The sending half of a stream."""

    __slots__ = (
        "_ack",
        "_ack_bits",
        "_backoff",
        "_ends",
        "_expired_s",
        "_limit",
        "_loss_at_s",
        "_lost",
        "_offset",
        "_pending",
        "_probe_at_s",
        "_resend",
        "_round_trip",
        "_sent",
        "_service",
        "_unacknowledged",
        "base",
        "counters",
        "is_probe_due",
        "next_number",
        "queued_bytes",
    )

    def __init__(self, service: Service, round_trip: RoundTrip, counters: ClassCounters) -> None:
        self._service = int(service)
        self._round_trip = round_trip
        self.counters = counters
        self.base = 0
        """The peer has every fragment below this."""
        self.next_number = 0
        """Number of the next fragment to be cut."""
        self.queued_bytes = 0
        """Bytes of the messages and their prefixes that the peer has not acknowledged."""
        self.is_probe_due = False
        self._limit = WINDOW_FRAGMENTS_MIN  # fragments below this are granted
        self._pending: deque[bytes] = deque()  # messages with prefix, not cut yet
        self._offset = 0  # of the first pending message: bytes cut already
        self._ends: deque[int] = deque()  # last fragment of every unacknowledged message
        self._unacknowledged: dict[int, Fragment] = {}
        self._sent: dict[int, Packet] = {}  # packets in flight, oldest first
        self._lost: dict[int, list[Fragment]] = {}  # packets held to be lost, oldest first
        self._resend: deque[Fragment] = deque()
        self._ack = 0
        self._ack_bits = 0
        self._backoff = 0
        self._expired_s = -_NEVER
        self._loss_at_s = _NEVER
        self._probe_at_s = _NEVER

    @property
    def is_full(self) -> bool:
        """Whether no further message is taken, whatever its size."""
        return len(self._pending) >= MESSAGES_QUEUED_MAX

    @property
    def has_output(self) -> bool:
        """Whether a fragment could go now, as far as the window is concerned."""
        return bool(self._resend) or (bool(self._pending) and self.next_number < self._limit)

    @property
    def is_listening(self) -> bool:
        """Whether acknowledgements of packets matter."""
        return bool(self._sent) or bool(self._lost)

    def push(self, body: bytes, channel: int) -> None:
        """Queue a message."""
        self._pending.append(MESSAGE_PREFIX.pack(channel << 24 | len(body)) + body)
        self.queued_bytes += _PREFIX_BYTES + len(body)
        self.counters.sent += 1

    def take(self, room: int) -> Fragment | None:
        """Return the next fragment whose frame fits into *room* bytes, those sent before first."""
        resend = self._resend
        while resend:
            fragment = resend[0]
            if fragment.is_acknowledged:
                resend.popleft()
                continue
            if len(fragment.frame) > room:
                return None
            resend.popleft()
            fragment.resends += 1
            self.counters.resent += 1
            return fragment
        if not self._pending or self.next_number >= self._limit:
            return None
        room -= FRAME_BYTES
        if room < min(len(self._pending[0]) - self._offset, FRAGMENT_BYTES_MIN):
            return None
        return self._cut(room)

    def _cut(self, room: int) -> Fragment:
        pending = self._pending
        number = self.next_number
        data = pending[0]
        if self._offset or len(data) > room:
            offset = self._offset
            left = len(data) - offset
            data = data[offset : offset + room]
            self._offset = offset + room
        else:
            left = len(data)
        if left <= room:
            pending.popleft()
            self._offset = 0
            self._ends.append(number)
            if pending and left + len(pending[0]) <= room:
                data = self._join(data, room)
        fragment = Fragment(number, FRAME.pack(self._service, 0, len(data), number) + data)
        self._unacknowledged[number] = fragment
        self.next_number = number + 1
        return fragment

    def _join(self, data: bytes, room: int) -> bytes:
        """Append whole pending messages while they fit."""
        pending = self._pending
        parts = [data]
        room -= len(data)
        while pending and len(pending[0]) <= room:
            part = pending.popleft()
            room -= len(part)
            parts.append(part)
            self._ends.append(self.next_number)
        return b"".join(parts)

    def record(self, packet_number: int, now_s: float, fragments: list[Fragment]) -> None:
        """Note which fragments a packet carried."""
        resends = 0
        for fragment in fragments:
            fragment.packet = packet_number
            if fragment.resends > resends:
                resends = fragment.resends
        kept_until_s = now_s
        if resends > FAST_RESENDS_MAX:
            kept_until_s += self._round_trip.get_resend_delay(resends - FAST_RESENDS_MAX)
        self._sent[packet_number] = Packet(now_s, fragments, kept_until_s)

    def advance(self, next_expected: int, granted: int) -> bool:
        """
        Take the receiver's state: the next fragment it expects, and how many from there it will hold.

        Returns:
            Whether messages were acknowledged.
        """
        limit = next_expected + granted
        if limit > self._limit:
            self._limit = limit
            self._probe_at_s = _NEVER
            self._backoff = 0
        if next_expected <= self.base:
            return False
        for number in range(self.base, next_expected):
            fragment = self._unacknowledged.get(number)
            if fragment is not None:
                self._settle(fragment)
        self.base = next_expected
        self._backoff = 0
        self._prune()
        ends = self._ends
        before = self.counters.acknowledged
        while ends and ends[0] < next_expected:
            ends.popleft()
            self.counters.acknowledged += 1
        return self.counters.acknowledged > before

    def _settle(self, fragment: Fragment) -> None:
        fragment.is_acknowledged = True
        del self._unacknowledged[fragment.number]
        self.queued_bytes -= len(fragment.frame) - FRAME_BYTES

    def _prune(self) -> None:
        """Forget the oldest packets in flight if all they carried has arrived by other ways."""
        sent = self._sent
        while sent:
            packet_number = next(iter(sent))
            for fragment in sent[packet_number].fragments:
                if not fragment.is_acknowledged:
                    return
            del sent[packet_number]

    def acknowledge(self, ack: int, ack_bits: int, now_s: float) -> None:
        """Take the receiver's packets: settle what arrived, find what is lost."""
        if ack < self._ack:
            return  # overtaken by a newer acknowledgement
        self._ack = ack
        self._ack_bits = ack_bits
        reorder_delay_s = self._round_trip.reorder_delay_s
        arrived: list[int] = []
        lost: list[int] = []
        loss_at_s = _NEVER
        for packet_number, packet in self._sent.items():
            age = ack - packet_number
            if age < 0:
                break
            if age == 0 or (age <= ACK_BITS and (ack_bits >> (age - 1)) & 1):
                arrived.append(packet_number)
                continue
            lost_at_s = packet.kept_until_s
            if age < REORDER_PACKETS and packet.sent_s + reorder_delay_s > lost_at_s:
                lost_at_s = packet.sent_s + reorder_delay_s
            if lost_at_s <= now_s:
                lost.append(packet_number)
            elif lost_at_s < loss_at_s:
                loss_at_s = lost_at_s
        self._loss_at_s = loss_at_s
        for packet_number in arrived:
            self._backoff = 0
            for fragment in self._sent.pop(packet_number).fragments:
                if not fragment.is_acknowledged:
                    self._settle(fragment)
        for packet_number in lost:
            self._lose(packet_number)
        if self._lost:
            self._find_spurious(ack, ack_bits)
        self._prune()

    def _lose(self, packet_number: int) -> None:
        fragments = self._sent.pop(packet_number).fragments
        self._resend.extend(f for f in fragments if not f.is_acknowledged)
        self._lost[packet_number] = fragments
        if len(self._lost) > LOST_PACKETS_MAX:
            del self._lost[next(iter(self._lost))]

    def _find_spurious(self, ack: int, ack_bits: int) -> None:
        """Look for packets that were held to be lost and arrived all the same."""
        for packet_number in list(self._lost):
            age = ack - packet_number
            if age > ACK_BITS:
                del self._lost[packet_number]  # no acknowledgement can name it any more
            elif age == 0 or (age > 0 and (ack_bits >> (age - 1)) & 1):
                for fragment in self._lost.pop(packet_number):
                    if fragment.packet != packet_number:
                        self.counters.resent_spurious += 1
                    if not fragment.is_acknowledged:
                        self._settle(fragment)

    def get_timer(self) -> float:
        """Return when `expire` wants to be called, infinity for never."""
        timer_s = min(self._loss_at_s, self._probe_at_s)
        if self._sent:
            timer_s = min(timer_s, self._get_resend_at())
        return timer_s

    def _get_resend_at(self) -> float:
        """Return when the oldest packet in flight is held to be lost: one a delay, whatever is in flight."""
        sent_s = next(iter(self._sent.values())).sent_s
        since_s = sent_s if sent_s > self._expired_s else self._expired_s
        return since_s + self._round_trip.get_resend_delay(self._backoff)

    def expire(self, now_s: float) -> None:
        """Do what is due by now."""
        if now_s >= self._loss_at_s:
            self.acknowledge(self._ack, self._ack_bits, now_s)
        if self._sent and now_s >= self._get_resend_at():
            self._lose(next(iter(self._sent)))
            self._backoff += 1
            self._expired_s = now_s
        if now_s >= self._probe_at_s:
            self._probe_at_s = _NEVER
            self.is_probe_due = True
            self._backoff += 1

    def arm_probe(self, now_s: float) -> None:
        """
        Set the probe timer if only a grant can help.

        A grant travels in every datagram of the receiver, but the receiver may have none to send: so
        a sender that has nothing in flight whose acknowledgement would bring it must ask.
        """
        if self._pending and self.next_number >= self._limit and not self._unacknowledged:
            if self._probe_at_s == _NEVER and not self.is_probe_due:
                self._probe_at_s = now_s + self._round_trip.get_resend_delay(self._backoff)
        else:
            self._probe_at_s = _NEVER
            self.is_probe_due = False

    def abandon(self) -> None:
        """Count every unacknowledged message as lost and forget them."""
        self.counters.lost += len(self._ends) + len(self._pending)
        self._pending.clear()
        self._offset = 0
        self._ends.clear()
        self._unacknowledged.clear()
        self._sent.clear()
        self._lost.clear()
        self._resend.clear()
        self.queued_bytes = 0
        self.is_probe_due = False
        self._loss_at_s = self._probe_at_s = _NEVER
