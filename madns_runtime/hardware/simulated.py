"""Devices that follow simulated time, in real time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from time import monotonic
from typing import Final

from madns_runtime.errors import PluginError
from madns_runtime.hardware import page
from madns_runtime.hardware.contract import Device, Sample, SimulatedDevice
from madns_runtime.hardware.records import SimulatedTime

AT_ONCE_S: Final = 0.01
"""Simulated time within which samples count as of one time, s: a driver that goes on by nanoseconds comes to no end either."""
AT_ONCE_MAX: Final = 10_000
"""Samples of one simulated time, unless they are finite; a tick's watchdog waits for longer than they take."""
ASKED_AGAIN_S: Final = 0.5
"""Until a device is asked again that has nothing new for longer: simulated time may come to be known, or run at another rate."""
STANDS_STILL: Final = (
    "next_s() should tell of a later time once sample_at() has given what there was"
)


def next_of(device: SimulatedDevice) -> float | None:
    """
    Return what a device's `next_s` tells.

    Raises:
        PluginError: It is no time.
    """
    told: object = device.next_s()
    if told is None:
        return None
    try:
        next_s = float(told)  # type: ignore[arg-type]  # what is none is refused below
    except (TypeError, ValueError):
        next_s = math.nan
    if math.isnan(next_s):
        raise PluginError(
            f"next_s: expected a simulated time, s, infinity for never, or None for its rate; got {told!r:.40}"
        )
    return next_s


class TimeProgress:
    """Sees to it that the times told by one device's `next_s` go on."""

    def __init__(self, device: SimulatedDevice) -> None:
        self._since_s, self._count = -math.inf, 0
        self._count_max = math.inf if device.is_finite else AT_ONCE_MAX

    def note(self, next_s: float) -> None:
        """
        Take note of one sample.

        Args:
            next_s: The time told of it, simulated, s.

        Raises:
            PluginError: The driver lets time stand still.
        """
        if next_s > self._since_s + AT_ONCE_S:
            self._since_s, self._count = next_s, 0
        self._count += 1
        if self._count > self._count_max:
            raise PluginError(
                f"more than {AT_ONCE_MAX} samples at {self._since_s:g} s: {STANDS_STILL}"
            )


def pass_over(device: Device, time: SimulatedTime, header: memoryview[float]) -> int:
    """
    Leave out what a device had to tell while it was not open: a recording goes on, and does not begin anew.

    Args:
        device: Just opened; nothing is left out of one that does not follow simulated time, or before that runs.
        time: Simulated time.
        header: Of its page, where its process is noted as active.

    Returns:
        How many samples were left out.

    Raises:
        PluginError: The driver lets time stand still.
    """
    if not isinstance(device, SimulatedDevice) or not time.is_known:
        return 0
    t_s, passed, progress = time.at(monotonic()), 0, TimeProgress(device)
    while (next_s := next_of(device)) is not None and next_s <= t_s:
        header[page.ACTIVE_S] = monotonic()
        progress.note(next_s)
        passed += device.sample_at(t_s) is not None
    return passed


def pause_s(time: SimulatedTime, next_s: float) -> float:
    """Return how long to wait before a device is asked that has something new at simulated time *next_s*, s."""
    return min(max(time.until(next_s), 0.0), ASKED_AGAIN_S) if time.is_known else ASKED_AGAIN_S


def is_waited_for(time: SimulatedTime, next_s: float | None) -> bool:
    """Tell whether a device may be silent, as it has told that it has nothing new before a simulated time to come."""
    return next_s is not None and not (time.is_known and time.until(next_s) < 0.0)


def samples_by_now(
    device: SimulatedDevice, time: SimulatedTime, header: memoryview[float], count_max: int
) -> Iterator[Sample]:
    """
    Yield what a device gives by now, taken at times of this machine's clock.

    Before simulated time runs, one that is asked at its rate gives what it gives at 0, and one whose samples have times of
    their own nothing, and is not waited for.

    Args:
        device: It is open.
        time: Simulated time.
        header: Of its page.
        count_max: Samples at most; the rest comes with the next call.
    """
    now_s = monotonic()
    t_s = time.at(now_s) if time.is_known else -math.inf
    next_s = next_of(device)
    if next_s is not None and t_s < 0.0:
        header[page.OPENED_S] = now_s
    for _ in range(count_max):
        if next_s is not None and next_s > t_s:
            return
        sample = device.sample_at(max(t_s, 0.0))
        if sample is not None:
            yield dataclasses.replace(sample, taken_s=now_s - (max(t_s, 0.0) - sample.taken_s))
        next_s = next_of(device)
        if next_s is None:
            return
