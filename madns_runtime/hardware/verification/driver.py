"""A driver called by hand: opened and closed again and again, asked for samples, told to move its outputs."""

from __future__ import annotations

import math
import os
import select
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from time import monotonic, sleep
from typing import Final

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, Device, Sample, SimulatedDevice
from madns_runtime.hardware.driver_answers import descriptor_of, details_of, identity_of
from madns_runtime.hardware.intake import checked_sample, promised_inputs
from madns_runtime.hardware.kind_registry import DeviceProgram
from madns_runtime.hardware.status import STALE_PERIODS, StatusLimits, sample_period_s
from madns_runtime.hardware.values import are_finite, hold_to_limits
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
AHEAD_S: Final = 1e-6
"""How far a sample may lie in the future, for rounding, s: a run lets it, by up to a period."""


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
        identity = identity_of(device.open())
        descriptor_of(device.fileno())
        _read(device, 0.0)
        details_of(device.health())
    finally:
        device.close()
    return identity


def _read(device: Device, t_s: float) -> Sample | None:
    if isinstance(device, SimulatedDevice):
        return device.sample_at(t_s)
    return device.read() if device.fileno() is None else None


@dataclass(slots=True)
class _Samples:
    """Samples of a driver, by what a run makes of them."""

    inputs: Mapping[str, Channel]
    count: int = 0
    fault: str = ""
    """Of the first that a run refuses."""
    youngest_s: float = math.inf
    """Least age of all."""
    given: set[str] = field(default_factory=set)
    """Inputs of which a value came."""
    beyond: dict[str, int] = field(default_factory=dict)
    """How often each input was beyond its limits."""

    def take(self, given: object, now_s: float) -> bool:
        """Look at what a driver gave; tell whether it is news."""
        if given is None:
            return False
        try:
            sample = checked_sample(given, self.inputs, now_s, ahead_s=AHEAD_S)
        except PluginError as error:
            self.fault = self.fault or str(error)
            return True
        if not sample.values and self.inputs:
            return False
        self.count += 1
        self.youngest_s = min(self.youngest_s, now_s - sample.taken_s)
        self.given |= sample.values.keys()
        for name, numbers in sample.values.items():
            channel = self.inputs[name]
            if isinstance(numbers, tuple) and not are_finite(numbers):
                self.fault = self.fault or f"{name}: {numbers} are not all numbers"
            elif isinstance(numbers, tuple) and hold_to_limits(channel, numbers)[1]:
                self.beyond[name] = self.beyond.get(name, 0) + 1
        return True

    def findings(self, stale_s: float) -> Findings:
        """Return what holds of them, where those older than *stale_s* are stale."""
        silent = [name for name in promised_inputs(self.inputs.values()) if name not in self.given]
        beyond = ", ".join(f"{name} {number} times" for name, number in self.beyond.items())
        is_young = self.youngest_s <= stale_s
        shapes = self.fault or f"{self.count} samples"
        is_known = self.count > 0
        return [
            finding("shapes", not self.fault if is_known or self.fault else None, shapes),
            finding("inputs", None if silent else True, _silent_text(silent) or "values of all"),
            finding("age", is_young if is_known else None, _age_text(self.youngest_s), f"{stale_s:g} s"),
            finding("limits", not beyond if is_known else None, beyond or "within", "declared limits"),
        ]  # fmt: skip


def _silent_text(silent: Sequence[str]) -> str:
    return f"no value came of {', '.join(silent)}" if silent else ""


def _age_text(age_s: float) -> str:
    return f"{age_s * 1e3:.4g} ms of the youngest sample" if math.isfinite(age_s) else "no sample"


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
    samples = _Samples({c.name: c for c in program.channels if c.direction == "in"})
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
                count += samples.take(device.read(), monotonic())
                continue
            sleep(max(0.0, due_s - monotonic()))
            t_s, asked_s = due_s - began_s, monotonic()
            sample = _read(device, t_s)
            reads_s.append(monotonic() - asked_s)
            if not isinstance(device, SimulatedDevice):
                count += samples.take(sample, monotonic())
            else:  # nothing new is no fault of one whose samples have times of their own
                count += samples.take(sample, t_s) or device.next_s() is not None
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
    sample_s = sample_period_s(rate_hz, program.channels)
    is_sparse = fd is None and STALE_PERIODS * rate_hz * sample_s * count < len(reads_s)
    of_reads = f": {count} samples in {len(reads_s)} reads" if is_sparse else ""
    return [
        finding(
            "rate",
            keeps_rate and not is_sparse if has_rate else None,
            "nothing came" if is_quiet else f"{got_hz:.1f} Hz{of_reads or _read_text(reads_s)}",
            f"{rate_hz:g} Hz",
        ),
        *samples.findings(StatusLimits.of(1.0 / rate_hz, 0.0, sample_s).stale_s),
    ]


def _read_text(reads_s: list[float]) -> str:
    return f", a read takes {median(reads_s) * 1e3:.1f} ms" if reads_s else ""


def move_outputs(program: DeviceProgram) -> Findings:
    """Write the limits of each output, then make it safe, whatever became of that."""
    device = program.make()
    try:
        device.open()
        try:
            written = _write_limits(device, program.channels)
        finally:
            device.make_safe()
        device.make_safe()
    finally:
        device.close()
    return [finding("outputs", True, f"{written} values written, made safe twice", "no error")]


def _write_limits(device: Device, channels: Sequence[Channel]) -> int:
    """Write the limits of each output of numbers, and return how many values that were."""
    written = 0
    for channel in channels:
        if channel.direction == "out" and not channel.is_frame:
            for number in channel.limits or (0.0,):
                value = [number] * channel.size if channel.shape else number
                device.write({channel.name: value}, monotonic())
                written += 1
    return written
