"""
Packets of a link: numbers sent and received, what is owed for them, round trips, and times of resends and of sending.

No clock here.
"""

from __future__ import annotations

from typing import Final

ACK_DELAY_MAX_S: Final = 0.015
"""The longest that an acknowledgement waits for a datagram to ride in; more than a tick of 100 Hz, so that
a message per tick costs one acknowledgement in two."""
ACK_DELAY_UNIT_S: Final = 1e-5
ACK_DELAY_UNITS_MAX: Final = 0xFFFF
"""This value says: that long or longer; such an acknowledgement gives no round trip."""
RESEND_FIRST_S: Final = 0.2
"""Resend delay until a round trip is known. 10 ms gave thousands of needless resends, 100 ms none."""
RESEND_SLACK_MIN_S: Final = 0.030
"""Least allowance for the peer's loop being busy; boards stall for 10 to 20 ms."""
RESEND_MAX_S: Final = 1.0
REORDER_PACKETS: Final = 3
"""A packet is lost when one sent this many later has arrived ..."""
REORDER_DELAY_MIN_S: Final = 0.005
"""... or any later one has, and it was sent longer ago than this and than 9/8 of a round trip."""
MEASURE_INTERVAL_S: Final = 0.1
"""While no stream waits for an acknowledgement, one round trip in so long is enough."""
PACE_QUANTUM_S: Final = 0.001
"""A pacing timer comes this much later than it could: several fragments a wake-up, not one."""
REPLAY_WINDOW_PACKETS: Final = 1024
"""A packet that is older than the newest by this many cannot be told from a repeat."""
ACK_BITS: Final = 64
ELICITING_PACKETS_MAX: Final = 2
"""Packets that want an acknowledgement: after so many it is sent at once."""
SENT_TIMES: Final = 256
"""An acknowledgement of a packet that is older than the newest by this many gives no round trip."""

_REPLAY_MASK: Final = (1 << REPLAY_WINDOW_PACKETS) - 1
_ACK_MASK: Final = (1 << ACK_BITS) - 1
_NEVER: Final = float("inf")


class RoundTrip:
    """
    Smoothed round trip time and what follows from it, both streams' common knowledge.

    Source: RFC 6298 (smoothing), RFC 9002 (delays of the acknowledgement taken out).
    """

    __slots__ = ("reorder_delay_s", "resend_delay_s", "srtt_s", "variation_s")

    def __init__(self) -> None:
        self.srtt_s: float | None = None
        self.variation_s = 0.0
        self.resend_delay_s = RESEND_FIRST_S
        self.reorder_delay_s = RESEND_FIRST_S

    def add(self, sample_s: float) -> None:
        """Take a measured round trip, without the time that the peer kept the acknowledgement."""
        srtt_s = self.srtt_s
        if srtt_s is None:
            srtt_s = sample_s
            self.variation_s = sample_s / 2
        else:
            self.variation_s += (abs(srtt_s - sample_s) - self.variation_s) / 4
            srtt_s += (sample_s - srtt_s) / 8
        self.srtt_s = srtt_s
        slack_s = 4 * self.variation_s
        if slack_s < RESEND_SLACK_MIN_S:
            slack_s = RESEND_SLACK_MIN_S
        self.resend_delay_s = srtt_s + slack_s + ACK_DELAY_MAX_S
        longest_s = sample_s if sample_s > srtt_s else srtt_s
        delay_s = 1.125 * longest_s
        self.reorder_delay_s = delay_s if delay_s > REORDER_DELAY_MIN_S else REORDER_DELAY_MIN_S

    def get_resend_delay(self, backoff: int) -> float:
        """Return how long to wait for an acknowledgement, s, doubled *backoff* times within bounds."""
        delay_s = self.resend_delay_s
        if backoff:
            ceiling_s = delay_s if delay_s > RESEND_MAX_S else RESEND_MAX_S
            # 2**16 is beyond the ceiling; the bound keeps the number small in an endless silence.
            delay_s = min(delay_s * (1 << min(backoff, 16)), ceiling_s)
        return delay_s


class TokenBucket:
    """A token bucket, kept as the time at which it would be full again."""

    __slots__ = ("_burst_s", "_full_at_s", "_s_per_byte", "opens_at_s")

    def __init__(self, bytes_per_s: float, burst_bytes: int) -> None:
        self._s_per_byte = 1.0 / bytes_per_s
        self._burst_s = burst_bytes / bytes_per_s
        self._full_at_s = float("-inf")
        self.opens_at_s = float("-inf")
        """Sending is allowed at and after this time."""

    def spend(self, count_bytes: int, now_s: float) -> None:
        """Note that bytes were sent."""
        full_at_s = self._full_at_s
        if full_at_s < now_s:
            full_at_s = now_s
        self._full_at_s = full_at_s + count_bytes * self._s_per_byte
        self.opens_at_s = self._full_at_s - self._burst_s


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
        """Time at which that came."""
        self.ack_due_s = _NEVER
        """Time to send an acknowledgement even if nothing else is."""
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
        """Times of sending of the newest packets, each at its number modulo the length."""
        self.acknowledged = 0
        """The newest packet sent that the peer is known to have."""
        self.are_awaited = False
        """Whether a stream waits for acknowledgements of packets."""
        self.measure_due_s = -_NEVER
        """Time from which on a round trip is measured even if no stream needs it."""
        self.round_trip = RoundTrip()

    @property
    def ack_bits(self) -> int:
        """Receipt of the 64 packets before the largest; bit 0 is the one just before."""
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
