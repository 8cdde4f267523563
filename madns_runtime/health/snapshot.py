"""State of health as values: what one look at a machine gives, and what two looks tell. Pure."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

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
class Memory:
    """RAM of the machine."""

    total_bytes: int
    used_bytes: int
    free_bytes: int
    """What could be had without swapping."""
    percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DiskSpace:
    """The file system that the run records on."""

    total_bytes: int
    used_bytes: int
    free_bytes: int
    """What this user may still fill."""
    percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DiskCounters:
    """All disks together, since the board's start."""

    reads: int
    writes: int
    read_bytes: int
    written_bytes: int
    read_time_ms: int
    write_time_ms: int


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkCounters:
    """All interfaces but loopback together, since they came up."""

    sent_bytes: int
    received_bytes: int
    sent_packets: int
    received_packets: int
    errors: int
    drops: int
    loopback_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One look at a machine; None is what it does not offer."""

    utc: str
    monotonic_s: float
    cpus: tuple[CpuTimes, ...]
    core_temperature_c: float | None
    throttled_bits: int | None
    memory: Memory
    disk_space: DiskSpace | None
    disk: DiskCounters | None
    network: NetworkCounters | None
    udp_sockets: int | None
    tcp_connections: int | None
    load: tuple[float, float, float] | None
    process_uptime_s: float
    board_uptime_s: float | None


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


def to_record(now: Reading, before: Reading | None) -> dict[str, Any]:
    """
    Return a record of the HEALTH stream, by field name.

    Args:
        now: The look at the machine that is recorded.
        before: An earlier one; without it loads and rates are None.
    """
    by_core = compute_cpu_percent(before.cpus, now.cpus) if before else []
    return {
        "utc": now.utc,
        "monotonic_s": round(now.monotonic_s, 3),
        "cpu_percent": round(sum(by_core) / len(by_core), 1) if by_core else None,
        "cpu_percent_by_core": by_core or None,
        "core_temperature_c": now.core_temperature_c,
        "throttled_bits": now.throttled_bits,
        "throttling": decode_throttling(now.throttled_bits),
        **_prefixed("ram", Memory, now.memory),
        **_prefixed("disk", DiskSpace, now.disk_space),
        **_prefixed("disk", DiskCounters, now.disk),
        **_network(now.network),
        **_rates(now, before),
        "udp_sockets": now.udp_sockets,
        "tcp_connections": now.tcp_connections,
        **dict(zip(("load_1min", "load_5min", "load_15min"), now.load or (None,) * 3, strict=True)),
        "process_uptime_s": round(now.process_uptime_s, 1),
        "board_uptime_s": now.board_uptime_s,
    }


def _prefixed(prefix: str, cls: type, value: Any) -> dict[str, Any]:
    return {
        f"{prefix}_{f.name}": None if value is None else getattr(value, f.name)
        for f in dataclasses.fields(cls)
    }


def _network(counters: NetworkCounters | None) -> dict[str, Any]:
    record = _prefixed("network", NetworkCounters, counters)
    record["loopback_bytes"] = record.pop("network_loopback_bytes")
    return record


def _rates(now: Reading, before: Reading | None) -> dict[str, float | None]:
    pairs = {
        "network_sent_bytes": ("network", "sent_bytes"),
        "network_received_bytes": ("network", "received_bytes"),
        "disk_read_bytes": ("disk", "read_bytes"),
        "disk_written_bytes": ("disk", "written_bytes"),
    }
    elapsed_s = now.monotonic_s - before.monotonic_s if before else 0.0
    return {
        f"{name}_per_s": compute_rate(_get(before, *path), _get(now, *path), elapsed_s)
        for name, path in pairs.items()
    }


def _get(reading: Reading | None, part: str, name: str) -> int | None:
    counters = getattr(reading, part, None)
    return getattr(counters, name, None)
