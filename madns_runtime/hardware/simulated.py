"""Devices that follow simulated time, in real time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from time import monotonic

from madns_runtime.hardware import page
from madns_runtime.hardware.contract import Device, Sample, SimulatedDevice
from madns_runtime.hardware.records import SimulatedTime


def pass_over(device: Device, time: SimulatedTime, header: memoryview[float]) -> int:
    """
    Leave out what a device had to tell while it was not open: a recording goes on, and does not begin anew.

    Args:
        device: Just opened; nothing is left out of one that does not follow simulated time, or before that runs.
        time: Simulated time.
        header: Of its page, where its process is noted as active.

    Returns:
        How many samples were left out.
    """
    if not isinstance(device, SimulatedDevice) or not time.is_known:
        return 0
    t_s, passed = time.at(monotonic()), 0
    while (next_s := device.next_s()) is not None and next_s <= t_s:
        header[page.ACTIVE_S] = monotonic()
        passed += device.sample_at(t_s) is not None
    return passed


def samples_by_now(
    device: SimulatedDevice, time: SimulatedTime, count_max: int
) -> Iterator[Sample]:
    """Yield what a device gives by now, at most so many, by this machine's clock; before simulated time runs, what at 0."""
    now_s = monotonic()
    t_s = time.at(now_s) if time.is_known else 0.0
    for _ in range(count_max):
        sample = device.sample_at(max(t_s, 0.0))
        if sample is not None:
            yield dataclasses.replace(sample, taken_s=now_s - (max(t_s, 0.0) - sample.taken_s))
        next_s = device.next_s()
        if next_s is None or next_s > t_s:
            return
