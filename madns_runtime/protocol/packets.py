"""Packet numbers of a link: those sent and the round trips they took, those received and what is owed for them."""

from __future__ import annotations

from typing import Final

from madns_runtime.protocol.recovery import (
    ACK_DELAY_MAX_S,
    ACK_DELAY_UNIT_S,
    ACK_DELAY_UNITS_MAX,
    MEASURE_INTERVAL_S,
    RoundTrip,
)

REPLAY_WINDOW_PACKETS: Final = 1024
"""A packet that is older than the newest by this many cannot be told from a repeat."""
ACK_BITS: Final = 64
ELICITING_PACKETS_MAX: Final = 2
"""So many packets that want an acknowledgement get one at once."""
SENT_TIMES: Final = 256
"""An acknowledgement of a packet that is older than the newest by this many gives no round trip."""

_REPLAY_MASK: Final = (1 << REPLAY_WINDOW_PACKETS) - 1
_ACK_MASK: Final = (1 << ACK_BITS) - 1
_NEVER: Final = float("inf")


class Packets:
    """
    The packets of a link.

    Received ones are kept as a sliding bitmap of numbers that refuses repeats and feeds the
    acknowledgements; of those sent, the times of the newest tell the round trip.
    """

    __slots__ = (
        "_bits",
        "_bits_at",
        "_eliciting",
        "_gapless_from",
        "ack_due_s",
        "acknowledged",
        "are_awaited",
        "largest",
        "largest_at_s",
        "measure_due_s",
        "newest",
        "round_trip",
        "sent_s",
    )

    def __init__(self) -> None:
        self.largest = 0
        """0 while none was received: packet numbers start at 1."""
        self.largest_at_s = 0.0
        """When that came."""
        self.ack_due_s = _NEVER
        """When an acknowledgement is to be sent even if nothing else is."""
        # Bit i: _bits_at - i was received. Those in order since then are shifted in when they are asked for,
        # which while nothing is lost is never: when the largest is above _gapless_from, all before it that an
        # acknowledgement names were received.
        self._bits = 0
        self._bits_at = 0
        self._gapless_from = ACK_BITS
        self._eliciting = 0  # packets not acknowledged yet that want to be
        self.newest = 0
        """Number of the packet that was sent last; they start at 1."""
        self.sent_s = [-_NEVER] * SENT_TIMES
        """When the newest packets were sent, each at its number modulo the length."""
        self.acknowledged = 0
        """The newest packet sent that the peer is known to have."""
        self.are_awaited = False
        """Whether a stream waits for acknowledgements of packets."""
        self.measure_due_s = -_NEVER
        """From when on a round trip is measured even if no stream needs it."""
        self.round_trip = RoundTrip()

    @property
    def ack_bits(self) -> int:
        """Which of the 64 packets before the largest were received; bit 0 is the one just before."""
        if self.largest > self._gapless_from:
            return _ACK_MASK
        return (self._get_bits() >> 1) & _ACK_MASK

    def _get_bits(self) -> int:
        """Return the bitmap, of all packets up to the largest."""
        in_order = self.largest - self._bits_at
        if in_order:
            shifted = self._bits << in_order if in_order < REPLAY_WINDOW_PACKETS else 0
            received = (1 << min(in_order, REPLAY_WINDOW_PACKETS)) - 1
            self._bits = (shifted | received) & _REPLAY_MASK
            self._bits_at = self.largest
        return self._bits

    def is_new(self, packet_number: int) -> bool:
        """Return whether a packet is neither repeated nor older than the window."""
        age = self.largest - packet_number
        if age < 0:
            return True
        return (
            age < REPLAY_WINDOW_PACKETS and not (self._get_bits() >> age) & 1 and packet_number > 0
        )

    def add(self, packet_number: int, now_s: float) -> bool:
        """
        Note a new packet.

        Returns:
            Whether it is the one after the newest: no gap, no change of order.
        """
        ahead = packet_number - self.largest
        if ahead == 1:
            self.largest = packet_number
            self.largest_at_s = now_s
            return True
        bits = self._get_bits()
        if ahead <= 0:
            self._bits = bits | 1 << -ahead
            return False
        # A far jump must not shift by as many bits as a peer likes.
        shifted = bits << ahead if ahead < REPLAY_WINDOW_PACKETS else 0
        self._bits = (shifted | 1) & _REPLAY_MASK
        self._bits_at = self.largest = packet_number
        self._gapless_from = packet_number - 1 + ACK_BITS
        self.largest_at_s = now_s
        return False

    def owe_ack(self, now_s: float, *, at_once: bool) -> None:
        """Note that a packet wants to be acknowledged."""
        self._eliciting += 1
        if at_once or self._eliciting >= ELICITING_PACKETS_MAX:
            self.ack_due_s = now_s
        else:
            # It may be due earlier already, to tell of a window.
            self.ack_due_s = min(self.ack_due_s, now_s + ACK_DELAY_MAX_S)

    def depart(self, now_s: float) -> tuple[int, int, int, int]:
        """
        Take note that a packet leaves.

        Returns:
            Its number, and what its header acknowledges: largest packet, those before it, delay.
        """
        self.newest = number = self.newest + 1
        self.sent_s[number % SENT_TIMES] = now_s
        self._eliciting = 0
        self.ack_due_s = _NEVER
        largest = self.largest
        ack_bits = _ACK_MASK if largest > self._gapless_from else self.ack_bits
        delay = int((now_s - self.largest_at_s) / ACK_DELAY_UNIT_S)
        if not 0 <= delay <= ACK_DELAY_UNITS_MAX:
            delay = 0 if delay < 0 else ACK_DELAY_UNITS_MAX
        return number, largest, ack_bits, delay

    def measure(self, ack: int, ack_delay: int, now_s: float) -> None:
        """Take a round trip from *ack*, the newest packet acknowledged so far."""
        self.acknowledged = ack
        self.measure_due_s = now_s + MEASURE_INTERVAL_S
        if ack_delay < ACK_DELAY_UNITS_MAX and self.newest - ack < SENT_TIMES:
            sample_s = now_s - self.sent_s[ack % SENT_TIMES] - ack_delay * ACK_DELAY_UNIT_S
            self.round_trip.add(sample_s if sample_s > 0 else 0.0)
