"""When to send again and how fast to send: round trip estimate, resend delays, pacing. No clock here."""

from __future__ import annotations

from typing import Final

ACK_DELAY_MAX_S: Final = 0.015
"""The longest that an acknowledgement waits for a datagram to ride in; more than a tick of 100 Hz, so that
a message a tick costs one acknowledgement in two."""
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


class RoundTrip:
    """
    Smoothed round trip time and what follows from it, both streams' common knowledge.

    Source: RFC 6298 (smoothing), RFC 9002 (delays of the acknowledgement taken out).
    """

    __slots__ = ("latest_s", "reorder_delay_s", "resend_delay_s", "srtt_s", "variation_s")

    def __init__(self) -> None:
        self.srtt_s: float | None = None
        self.variation_s = 0.0
        self.latest_s = 0.0
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
        self.latest_s = sample_s
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


class Pacer:
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
