"""State of health as values: what one look at a machine gives, and what two looks tell. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from madns_runtime.recording.records import HEALTH

RATED = ("network_sent_bytes", "network_received_bytes", "disk_read_bytes", "disk_written_bytes")
"""Counters whose increase per second is recorded, too."""
THROTTLING_BITS = {
    0: "under_voltage",
    1: "frequency_capped",
    2: "throttled",
    3: "soft_temperature_limit",
    16: "under_voltage_occurred",
    17: "frequency_capped_occurred",
    18: "throttled_occurred",
    19: "soft_temperature_limit_occurred",
}
"""Meaning of the Raspberry Pi firmware's get_throttled bits; 16 and up have been true since the board's start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CpuTimes:
    """Seconds that one processor has been busy, and has been at all."""

    busy_s: float
    total_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthReading:
    """One look at a machine."""

    cpus: tuple[CpuTimes, ...]
    values: Mapping[str, Any]
    """By field of the HEALTH stream; what the machine does not offer is None, or not there."""


def decode_throttling(bits: int | None) -> tuple[str, ...] | None:
    """Return the names of the set bits, None if there are no bits; unknown ones are bit_<number>."""
    if bits is None:
        return None
    numbers = [number for number in range(bits.bit_length()) if bits >> number & 1]
    return tuple(THROTTLING_BITS.get(number, f"bit_{number}") for number in numbers)


def parse_throttled(text: str) -> int | None:
    """Return the bits from the firmware's hexadecimal text, None if it is none."""
    try:
        return int(text.strip().removeprefix("throttled="), 16)
    except ValueError:
        return None


def compute_cpu_percent(before: tuple[CpuTimes, ...], now: tuple[CpuTimes, ...]) -> list[float]:
    """Return each processor's load between two readings, %; empty if processors came or went."""
    if len(before) != len(now):
        return []
    return [_percent(a, b) for a, b in zip(before, now, strict=True)]


def _percent(before: CpuTimes, now: CpuTimes) -> float:
    total_s = now.total_s - before.total_s
    if total_s <= 0:
        return 0.0
    return round(min(100.0, max(0.0, 100.0 * (now.busy_s - before.busy_s) / total_s)), 1)


def compute_rate(before: int | None, now: int | None, elapsed_s: float) -> float | None:
    """Return a counter's increase a second, None where either is missing, no time passed, or it went back."""
    if before is None or now is None or elapsed_s <= 0 or now < before:
        return None
    return round((now - before) / elapsed_s, 1)


def to_record(now: HealthReading, before: HealthReading | None) -> dict[str, Any]:
    """
    Return a record of the HEALTH stream, by field name.

    Args:
        now: The look at the machine that is recorded.
        before: An earlier one; without it loads and rates are None.
    """
    by_core = compute_cpu_percent(before.cpus, now.cpus) if before else []
    earlier = before.values if before else {}
    elapsed_s = now.values["monotonic_s"] - earlier.get("monotonic_s", math.inf)
    return {
        **dict.fromkeys(field.name for field in HEALTH.fields),
        **now.values,
        "monotonic_s": round(now.values["monotonic_s"], 3),
        "cpu_percent": round(sum(by_core) / len(by_core), 1) if by_core else None,
        "cpu_percent_by_core": by_core or None,
        "throttling": decode_throttling(now.values.get("throttled_bits")),
        **{
            f"{name}_per_s": compute_rate(earlier.get(name), now.values.get(name), elapsed_s)
            for name in RATED
        },
    }
