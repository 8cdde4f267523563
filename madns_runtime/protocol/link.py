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

from typing import Final

from madns_runtime.protocol.counters import LinkCounters
from madns_runtime.protocol.datagram import (
    AT_ONCE,
    CHANNEL_MAX,
    ELICITING,
    HEADER_REST,
    PREFIX_BYTES,
    STREAMS,
    Role,
    Seal,
)
from madns_runtime.protocol.incoming import Incoming
from madns_runtime.protocol.link_settings import PLUGIN_CHANNEL, LinkLimits
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.outgoing import Outgoing
from madns_runtime.protocol.packets import Packets

_BEST: Final = int(Service.BEST)
_SYNC: Final = int(Service.SYNC)


class Link:
    """
    One peer's conversation.

    What one half of it does alone is that half's method, handed out without a call between: see
    `Incoming` for `open_best` and `next_message`, `Outgoing` for the others.
    """

    __slots__ = (
        "_counters",
        "_incoming",
        "_outgoing",
        "_packets",
        "_seal",
        "datagrams_to_send",
        "get_timer",
        "handle_timer",
        "incarnation_id",
        "next_broken_deadline",
        "next_message",
        "open_best",
        "peer_prefix",
        "seal_best",
        "was_forged",
    )

    def __init__(self, *, seal: Seal, limits: LinkLimits = LinkLimits()) -> None:  # noqa: B008 - frozen
        self._counters = counters = LinkCounters()
        self._seal = seal
        self.was_forged = False
        """Whether the datagram that was refused last is not from this peer, or was changed on the way."""
        self.incarnation_id = seal.incarnation_id
        """Incarnation of the agent's process in this conversation."""
        self.peer_prefix = seal.peer_prefix
        """The first bytes of every datagram from this peer: a key to find the link by."""
        self._packets = packets = Packets()
        self._incoming = incoming = Incoming(seal, limits, counters=counters, packets=packets)
        self._outgoing = outgoing = Outgoing(
            seal, limits, counters=counters, packets=packets, incoming=incoming
        )
        self.open_best = incoming.open_best
        self.next_message = incoming.next_message
        self.seal_best = outgoing.seal_best
        self.datagrams_to_send = outgoing.datagrams_to_send
        self.get_timer = outgoing.get_timer
        self.handle_timer = outgoing.handle_timer
        self.next_broken_deadline = outgoing.watch.next_broken

    @classmethod
    def for_agent(
        cls,
        run_key: bytes,
        session: bytes,
        agent_index: int,
        incarnation_id: int,
        *,
        limits: LinkLimits = LinkLimits(),  # noqa: B008 - frozen
    ) -> Link:
        """Return the agent's end of a conversation; see `datagram.derive_keys` for the arguments."""
        return cls(
            seal=Seal.derive(run_key, session, agent_index, incarnation_id, Role.AGENT),
            limits=limits,
        )

    # What the owner asks.

    @property
    def counters(self) -> LinkCounters:
        """Counts of everything sent, received and refused until now."""
        counters = self._counters
        # What their numbers tell is not counted again with every tick.
        counters.datagrams_sent = self._packets.newest
        counters.best.sent = sum(self._outgoing.best.numbers.values())
        counters.best.of_half = self._outgoing.best.numbers.get(PLUGIN_CHANNEL, 0)
        counters.best.reached = self._incoming.best_reached(PLUGIN_CHANNEL)
        return counters

    @property
    def is_flushed(self) -> bool:
        """Whether nothing reliable is queued or unacknowledged."""
        return not self.queued_bytes

    @property
    def queued_bytes(self) -> int:
        """Bytes of both streams that wait or are not acknowledged."""
        return sum(stream.queued_bytes for stream in self._outgoing.streams)

    @property
    def held_bytes(self) -> int:
        """Bytes of both streams received and not finished to messages."""
        return sum(stream.held_bytes for stream in self._incoming.streams)

    @property
    def srtt_s(self) -> float | None:
        """Smoothed round trip, s, without the peer's delay; None before the first."""
        return self._packets.round_trip.srtt_s

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
        outgoing = self._outgoing
        outgoing.now_s = now_s
        if not 0 <= channel <= CHANNEL_MAX:
            raise ValueError(f"expected a channel of 0 to {CHANNEL_MAX}, got {channel}")
        if service == _BEST:
            outgoing.best.push(body, channel)
            return
        stream = outgoing.streams[service - 1]
        outgoing.check_room(stream, len(body))
        if deadline_s is not None and service == _SYNC:
            outgoing.watch.add(stream.counters.sent, deadline_s, now_s, (channel, body))
        stream.push(body, channel)

    def send_urgent(self, body: bytes, service: Service, now_s: float) -> None:
        """Queue one of the framework's own few words, also in a stream whose queue is full."""
        outgoing = self._outgoing
        outgoing.now_s = now_s
        if service == _BEST:
            outgoing.best.push(body, 0)
        else:
            outgoing.streams[service - 1].push(body, 0)

    # Receiving.

    def receive_datagram(self, data: bytes, now_s: float) -> bool:
        """
        Take a datagram.

        Returns:
            False if it was refused and counted: not from this peer, changed, repeated or malformed.
        """
        self._outgoing.now_s = now_s
        forgery = self._seal.find_fault(data)
        fault = forgery or self._accept(data, now_s)
        if fault is None:
            return True
        self.was_forged = forgery is not None
        self.refuse(fault)
        return False

    def refuse(self, reason: str) -> None:
        """Count a datagram that is refused."""
        refused = self._counters.refused
        refused[reason] = refused.get(reason, 0) + 1

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
        ) = HEADER_REST.unpack_from(data, PREFIX_BYTES)
        incoming, outgoing, packets = self._incoming, self._outgoing, self._packets
        if not packets.is_new(packet_number):
            return "replay"
        account = STREAMS.unpack(streams)
        reliable, sync = outgoing.streams
        if (
            ack > packets.newest
            or account[0] > reliable.next_number
            or account[1] > sync.next_number
        ):
            return "malformed"
        frames = incoming.parse(data)
        if frames is None:
            return "malformed"

        is_in_order = packets.add(packet_number, now_s)
        counters = self._counters
        counters.datagrams_received += 1
        counters.bytes_received += len(data)
        if ack > packets.acknowledged:
            packets.measure(ack, ack_delay, now_s)
        if packets.are_awaited or streams != incoming.streams_heard:
            outgoing.acknowledge(ack, ack_bits, account, now_s)
            incoming.streams_heard = streams
        if contents & ELICITING:
            packets.owe_ack(now_s, at_once=not is_in_order or bool(contents & AT_ONCE))
        incoming.take(frames)
        return None

    def abandon(self, *services: Service) -> None:
        """
        Give streams up, all without an argument: what is not acknowledged is counted as lost and forgotten.

        Nothing can be sent in such a stream again: its receiver waits for what is gone. Deadlines that are
        still open are broken.
        """
        for service in services or (Service.RELIABLE, Service.SYNC):
            self._outgoing.streams[service - 1].abandon()
            if service == _SYNC:
                self._outgoing.watch.give_up()
