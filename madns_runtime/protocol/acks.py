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

    __slots__ = ("_bits", "_eliciting", "_largest_at_s", "ack_due_s", "largest")

    def __init__(self) -> None:
        self.largest = 0
        """0 while none was received: packet numbers start at 1."""
        self.ack_due_s = _NEVER
        """When an acknowledgement is to be sent even if nothing else is."""
        self._bits = 0  # bit i: largest - i was received
        self._largest_at_s = 0.0
        self._eliciting = 0  # packets not acknowledged yet that want to be

    @property
    def ack_bits(self) -> int:
        """Which of the 64 packets before the largest were received; bit 0 is the one just before."""
        return (self._bits >> 1) & _ACK_MASK

    def is_new(self, packet_number: int) -> bool:
        """Return whether a packet is neither repeated nor older than the window."""
        age = self.largest - packet_number
        if age < 0:
            return True
        return age < REPLAY_WINDOW_PACKETS and not (self._bits >> age) & 1 and packet_number > 0

    def add(self, packet_number: int, now_s: float) -> bool:
        """
        Note a new packet.

        Returns:
            Whether it is the one after the newest: no gap, no change of order.
        """
        ahead = packet_number - self.largest
        if ahead <= 0:
            self._bits |= 1 << -ahead
            return False
        # A far jump must not shift by as many bits as a peer likes.
        shifted = self._bits << ahead if ahead < REPLAY_WINDOW_PACKETS else 0
        self._bits = (shifted | 1) & _REPLAY_MASK
        self.largest = packet_number
        self._largest_at_s = now_s
        return ahead == 1

    def owe_ack(self, now_s: float, *, at_once: bool) -> None:
        """Note that a packet wants to be acknowledged."""
        self._eliciting += 1
        if at_once or self._eliciting >= ELICITING_PACKETS_MAX:
            self.ack_due_s = now_s
        else:
            # It may be due earlier already, to tell of a window.
            self.ack_due_s = min(self.ack_due_s, now_s + ACK_DELAY_MAX_S)

    def settle_ack(self, now_s: float) -> int:
        """Note that a datagram acknowledges everything; return the delay that its header tells."""
        self._eliciting = 0
        self.ack_due_s = _NEVER
        delay = int((now_s - self._largest_at_s) / ACK_DELAY_UNIT_S)
        return 0 if delay < 0 else min(delay, ACK_DELAY_UNITS_MAX)
