"""A driver called by hand: opened and closed again and again, asked for samples, told to move its outputs."""

from __future__ import annotations

import math
import os
import select
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from time import monotonic, sleep
from typing import Any, Final

from madns_runtime.errors import MadnsError
from madns_runtime.hardware.contract import Channel, Device, Sample, SimulatedDevice
from madns_runtime.hardware.kind_registry import DeviceProgram
from madns_runtime.hardware.status import STALE_PERIODS, sample_period_s
from madns_runtime.hardware.values import are_finite, hold_to_limits, to_frame, to_numbers
from madns_runtime.hardware.verification.order import (
    MEMORY_BYTES_MAX,
    Findings,
    VerificationFinding,
    finding,
)

WARM_UP: Final = 10
SETTLE_S: Final = 2.0
"""For threads that were joined: the kernel lists one a moment longer."""
UNIT_LENGTH_MAX: Final = 16


def units_of(program: DeviceProgram) -> VerificationFinding:
    """Look at the units that a driver declares."""
    units = {channel.name: channel.unit for channel in program.channels}
    bad = [n for n, unit in units.items() if not unit.isprintable() or len(unit) > UNIT_LENGTH_MAX]
    told = ", ".join(f"{name} {unit or '-'}" for name, unit in units.items())
    return finding("units", not bad, told, f"printable, at most {UNIT_LENGTH_MAX} characters")


def held() -> tuple[int, int, int]:
    """Return the descriptors, threads and bytes of memory that this process has."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    threads = len(os.listdir("/proc/self/task"))
    return len(os.listdir("/proc/self/fd")), threads, pages * os.sysconf("SC_PAGE_SIZE")


def open_often(program: DeviceProgram, cycles: int) -> Findings:
    """Open and close a device again and again; what it holds afterwards it held before."""
    for _ in range(WARM_UP):
        _open_once(program)
    before = held()
    identities = {_open_once(program) for _ in range(cycles)}
    until_s = monotonic() + SETTLE_S
    while held()[1] > before[1] and monotonic() < until_s:
        sleep(0.01)
    fds, threads, memory_bytes = (b - a for a, b in zip(before, held(), strict=True))
    return [
        finding("opened and closed", True, f"{cycles} times", f"{cycles} times"),
        finding(
            "identity", len(identities) == 1, ", ".join(sorted(identities)), "the same each time"
        ),
        finding("descriptors", fds <= 0, f"{fds:+d}", "+0"),
        finding("threads", threads <= 0, f"{threads:+d}", "+0"),
        finding(
            "memory",
            memory_bytes <= MEMORY_BYTES_MAX,
            f"{memory_bytes / 2**20:+.1f} MiB",
            f"{MEMORY_BYTES_MAX / 2**20:+.1f} MiB",
        ),
    ]


def _open_once(program: DeviceProgram) -> str:
    device = program.make()
    try:
        identity = device.open()
        _read(device, 0.0)
        device.health()
    finally:
        device.close()
    return str(identity)


def _read(device: Device, t_s: float) -> Sample | None:
    if isinstance(device, SimulatedDevice):
        return device.sample_at(t_s)
    return device.read() if device.fileno() is None else None


def take_samples(
    program: DeviceProgram, rate_hz: float, sampling_s: float, *, is_asked: bool
) -> Findings:
    """
    Take samples for a while, and look at them.

    Args:
        program: The driver.
        rate_hz: How often it is asked.
        sampling_s: For how long.
        is_asked: Whether a device that sends by itself is known to do so at this rate.
    """
    device = program.make()
    faults: list[str] = []
    beyond: dict[str, int] = {}
    inputs = {c.name: c for c in program.channels if c.direction == "in"}
    count, wanted = 0, max(1, round(rate_hz * sampling_s))
    reads_s: list[float] = []
    try:
        device.open()
        fd = device.fileno()
        began_s = monotonic()
        until_s = began_s + 2 * sampling_s
        while count < wanted and monotonic() < until_s:
            due_s = began_s + (len(reads_s) + 1) / rate_hz
            if fd is not None:
                select.select([fd], [], [], max(0.0, until_s - monotonic()))
                sample = device.read()
            else:
                sleep(max(0.0, due_s - monotonic()))
                t_s, asked_s = due_s - began_s, monotonic()
                sample = _read(device, t_s)
                reads_s.append(monotonic() - asked_s)
                if isinstance(device, SimulatedDevice) and device.next_s() is not None:
                    sample = sample or Sample(values={}, taken_s=t_s)  # nothing new is no fault
            if sample is not None:
                count += 1
                now_s = monotonic() if not isinstance(device, SimulatedDevice) else due_s - began_s
                faults += _sample_faults(sample, inputs, now_s, beyond)
        elapsed_s = monotonic() - began_s
    finally:
        device.close()
    got_hz = count / elapsed_s
    is_quiet = fd is not None and not count
    has_rate = fd is None or (is_asked and not is_quiet)
    # What another program of this machine costs is no fault of the driver's: half of its reads say what it needs.
    read_s = median(reads_s) if reads_s else math.inf
    keeps_rate = got_hz >= 0.99 * rate_hz * wanted / (wanted + 1) or read_s <= 1.0 / rate_hz
    # In a run a device that gives less often is stale, and lost.
    reads_each = rate_hz * sample_period_s(rate_hz, program.channels)
    is_sparse = fd is None and STALE_PERIODS * reads_each * count < len(reads_s)
    of_reads = f": {count} samples in {len(reads_s)} reads" if is_sparse else ""
    told = ", ".join(f"{name} {number} times" for name, number in beyond.items())
    return [
        finding(
            "rate",
            keeps_rate and not is_sparse if has_rate else None,
            "nothing came" if is_quiet else f"{got_hz:.1f} Hz{of_reads or _read_text(reads_s)}",
            f"{rate_hz:g} Hz",
        ),
        finding("shapes", not faults if count else None, faults[0] if faults else f"{count} samples"),
        finding("limits", not beyond if count else None, told or "within", "declared limits"),
    ]  # fmt: skip


def _read_text(reads_s: list[float]) -> str:
    return f", a read takes {median(reads_s) * 1e3:.1f} ms" if reads_s else ""


def _sample_faults(
    sample: Any, inputs: Mapping[str, Channel], now_s: float, beyond: dict[str, int]
) -> list[str]:
    """Return what is wrong with a sample; values beyond their limits are counted."""
    if not isinstance(sample, Sample):
        return [f"expected a Sample or None, got {type(sample).__name__}"]
    if not sample.taken_s <= now_s + 1e-6:
        return [f"taken_s {sample.taken_s:g} lies in the future"]
    try:
        for name, value in sample.values.items():
            channel = inputs.get(name)
            if channel is None:
                return [f"{name} is no input of the device"]
            if channel.is_frame:
                to_frame(channel, value)
                continue
            numbers = to_numbers(channel, value)
            if not are_finite(numbers):
                return [f"{name}: {numbers} are not all numbers"]
            if hold_to_limits(channel, numbers)[1]:
                beyond[name] = beyond.get(name, 0) + 1
    except MadnsError as error:
        return [str(error)]
    return []


def move_outputs(program: DeviceProgram) -> Findings:
    """Write the limits of each output, then make it safe."""
    device = program.make()
    written = 0
    try:
        device.open()
        for channel in program.channels:
            if channel.direction == "out" and not channel.is_frame:
                for number in channel.limits or (0.0,):
                    value = [number] * channel.size if channel.shape else number
                    device.write({channel.name: value}, monotonic())
                    written += 1
        device.make_safe()
        device.make_safe()
    finally:
        device.close()
    return [finding("outputs", True, f"{written} values written, made safe twice", "no error")]
