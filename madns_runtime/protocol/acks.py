"""What a link acknowledges, and when: packet numbers received, and the acknowledgement owed for them."""

from __future__ import annotations

from typing import Final

from madns_runtime.protocol.recovery import (
    ACK_DELAY_MAX_S,
    ACK_DELAY_UNIT_S,
    ACK_DELAY_UNITS_MAX,
)

REPLAY_WINDOW_PACKETS: Final = 1024
"""A packet that is older than the newest by this many cannot be told from a repeat."""
ACK_BITS: Final = 64
ELICITING_PACKETS_MAX: Final = 2
"""So many packets that want an acknowledgement get one at once."""

_REPLAY_MASK: Final = (1 << REPLAY_WINDOW_PACKETS) - 1
_ACK_MASK: Final = (1 << ACK_BITS) - 1
_NEVER: Final = float("inf")


class ReceivedPackets:
    """A sliding bitmap of packet numbers that refuses repeats and feeds the acknowledgements."""

    __slots__ = (
        "_bits",
        "_bits_at",
        "_eliciting",
        "_gap_at",
        "_largest_at_s",
        "ack_due_s",
        "largest",
    )

    def __init__(self) -> None:
        self.largest = 0
        """0 while none was received: packet numbers start at 1."""
        self.ack_due_s = _NEVER
        """When an acknowledgement is to be sent even if nothing else is."""
        # Bit i: _bits_at - i was received. Those in order since then are shifted in when they are asked for,
        # which while nothing is lost is never: so much is known of all packets after _gap_at.
        self._bits = 0
        self._bits_at = 0
        self._gap_at = 0
        self._largest_at_s = 0.0
        self._eliciting = 0  # packets not acknowledged yet that want to be

    @property
    def ack_bits(self) -> int:
        """Which of the 64 packets before the largest were received; bit 0 is the one just before."""
        if self.largest - self._gap_at > ACK_BITS:
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
            self._largest_at_s = now_s
            return True
        bits = self._get_bits()
        if ahead <= 0:
            self._bits = bits | 1 << -ahead
            return False
        # A far jump must not shift by as many bits as a peer likes.
        shifted = bits << ahead if ahead < REPLAY_WINDOW_PACKETS else 0
        self._bits = (shifted | 1) & _REPLAY_MASK
        self._bits_at = self.largest = packet_number
        self._gap_at = packet_number - 1
        self._largest_at_s = now_s
        return False

    def owe_ack(self, now_s: float, *, at_once: bool) -> None:
        """Note that a packet wants to be acknowledged."""
        self._eliciting += 1
        if at_once or self._eliciting >= ELICITING_PACKETS_MAX:
            self.ack_due_s = now_s
        else:
            # It may be due earlier already, to tell of a window.
            self.ack_due_s = min(self.ack_due_s, now_s + ACK_DELAY_MAX_S)

    def acknowledge(self, now_s: float) -> tuple[int, int, int]:
        """Return what a datagram's header acknowledges: largest packet, those before it, delay."""
        self._eliciting = 0
        self.ack_due_s = _NEVER
        largest = self.largest
        ack_bits = _ACK_MASK if largest - self._gap_at > ACK_BITS else self.ack_bits
        delay = int((now_s - self._largest_at_s) / ACK_DELAY_UNIT_S)
        if not 0 <= delay <= ACK_DELAY_UNITS_MAX:
            delay = 0 if delay < 0 else ACK_DELAY_UNITS_MAX
        return largest, ack_bits, delay
