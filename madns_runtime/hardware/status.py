"""
Status of a device as its users see it, and when its process is given up. Pure: times go in, words come out.

*never*: open, no sample yet. *ok*. *stale*: the newest sample is older than 3 periods, and than 0.1 s.
*lost*: no sample for 10 periods and 1 s, closed, or *never* for that long.
A period is `sample_period_s`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from madns_runtime.config import DeviceLaunch
from madns_runtime.hardware.contract import Channel
from madns_runtime.plugin.device_view import DeviceStatus

STALE_PERIODS = 3.0
STALE_S_MIN = 0.1
LOST_PERIODS = 10.0
LOST_S_MIN = 1.0
BACK_OFF_S_MIN = 0.1
BACK_OFF_S_MAX = 1.0


@dataclass(frozen=True, slots=True)
class StatusLimits:
    """Ages from which a device counts as stale, as lost, and as hung, s."""

    stale_s: float
    lost_s: float
    hang_s: float

    @classmethod
    def of(cls, period_s: float, hang_s: float, sample_s: float = 0.0) -> StatusLimits:
        """Return the limits of a device that is read every *period_s* seconds and gives samples every *sample_s*, if that is longer."""
        slow_s = max(period_s, sample_s)
        return cls(
            stale_s=max(STALE_PERIODS * slow_s, STALE_S_MIN),
            lost_s=max(LOST_PERIODS * slow_s, LOST_S_MIN),
            hang_s=max(hang_s, LOST_PERIODS * period_s),
        )

    def status(
        self, age_s: float, *, silent_s: float, waited_s: float, is_open: bool
    ) -> DeviceStatus:
        """
        Return the status.

        Args:
            age_s: Time since the newest sample was taken; infinite if there is none.
            silent_s: Time since a sample last arrived: a slow read brings samples that are old already.
            waited_s: Time since the device was opened, s.
            is_open: Whether it is open.
        """
        if not is_open:
            return "lost"
        if math.isinf(age_s):
            return "never" if waited_s <= self.lost_s else "lost"
        if age_s <= self.stale_s:
            return "ok"
        return "stale" if silent_s <= self.lost_s else "lost"


def sample_rate_hz(rate_hz: float, channels: Sequence[Channel]) -> float:
    """
    Return how often a device gives samples, Hz: as often as it is read, or less where all its inputs are slower.

    Args:
        rate_hz: At which it is read.
        channels: The device's; inputs of frames and queues promise no rate.
    """
    rates = [
        each.rate_hz_max
        for each in channels
        if each.direction == "in" and each.passing == "newest" and not each.is_frame
    ]
    fastest_hz = max(
        (rate if rate and rate > 0.0 else math.inf for rate in rates), default=math.inf
    )
    return min(rate_hz, fastest_hz)


def sample_period_s(rate_hz: float, channels: Sequence[Channel]) -> float:
    """Return the time from one sample of a device to the next, s; see `sample_rate_hz`."""
    return 1.0 / sample_rate_hz(rate_hz, channels)


def limits_of(launch: DeviceLaunch, channels: Sequence[Channel]) -> StatusLimits:
    """Return the limits of a device with such channels."""
    sample_s = sample_period_s(launch.rate_hz, channels)
    return StatusLimits.of(1.0 / launch.rate_hz, launch.hang_s, sample_s)


def back_off_s(failures: int) -> float:
    """Return how long to wait before a device is opened anew, s, after so many failures in a row."""
    return min(BACK_OFF_S_MAX, BACK_OFF_S_MIN * 2.0 ** max(0, min(failures, 10) - 1))


@dataclass(slots=True)
class StatusAccount:
    """Summary of a device's statuses over a run, by which its checks are judged."""

    status: DeviceStatus = "never"
    since_s: float = 0.0
    """Time from which it is so, s."""
    seconds: dict[DeviceStatus, float] = field(
        default_factory=lambda: {"never": 0.0, "ok": 0.0, "stale": 0.0, "lost": 0.0}
    )
    times_lost: int = 0
    counted_s: float | None = None
    """Up to here time has been counted; None before simulated time runs."""
    end_s: float = math.inf
    """When simulated time is over: nothing counts from then on."""

    def observe(self, status: DeviceStatus, now_s: float) -> DeviceStatus | None:
        """Note the status at *now_s*, and return the one before if it has changed."""
        if self.counted_s is not None:
            until_s = max(self.counted_s, min(now_s, self.end_s))
            self.seconds[self.status] += until_s - self.counted_s
            self.counted_s = until_s
        if status == self.status:
            return None
        before, self.status, self.since_s = self.status, status, now_s
        if status == "lost" and self.counted_s is not None and now_s <= self.end_s:
            self.times_lost += 1
        return before

    def begin(self, now_s: float) -> None:
        """Count from now on: simulated time runs. A device that is lost by now is a loss."""
        self.counted_s = now_s
        self.times_lost = int(self.status == "lost")

    def stale_ratio(self) -> float | None:
        """Return the share of time in which its newest sample was stale, or there was none; None if no time passed."""
        total_s = sum(self.seconds.values())
        return (total_s - self.seconds["ok"]) / total_s if total_s > 0 else None
