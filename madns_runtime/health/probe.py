"""
A look at the machine and at the own process: the only place that asks the kernel how they fare.

Every look is cheap (small files of /proc and /sys, no walk over processes or sockets); what a machine does not
offer is None, never an error.
"""

from __future__ import annotations

import os
import resource
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil

from madns_runtime.health.snapshot import CpuTimes, HealthReading, parse_throttled

THERMAL_ZONES = "sys/class/thermal/thermal_zone*"
CPU_ZONE_TYPES = ("cpu-thermal", "cpu_thermal", "x86_pkg_temp", "soc_thermal", "cpu", "soc")
"""Types of thermal zones that are the processor's, the best first."""
THROTTLED_FILES = ("sys/devices/platform/soc/soc:firmware", "sys/devices/platform/soc*/*firmware")
ROOT = Path("/")


class Probe:
    """
    Looks at one machine, again and again.

    Args:
        directory: A path on the file system whose space is watched.
        root: Where proc and sys are mounted; another one in tests.
    """

    def __init__(self, directory: Path, *, root: Path = ROOT) -> None:
        self._directory = directory
        self._proc_net = root / "proc/net"
        self._temperature_file = _find_temperature_file(root)
        self._throttled_file = _find_throttled_file(root)
        self._started_s = time.monotonic()

    def read(self) -> HealthReading:
        """Take one look."""
        memory = psutil.virtual_memory()
        now_s = time.monotonic()
        values = {
            "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "monotonic_s": now_s,
            "core_temperature_c": self._read_temperature(),
            "throttled_bits": self._read_throttled(),
            "ram_total_bytes": memory.total,
            "ram_used_bytes": memory.used,
            "ram_free_bytes": memory.available,  # what could be had without swapping
            "ram_percent": memory.percent,
            **_read_disk_space(self._directory),
            **_read_disk(),
            **_read_network(),
            "udp_sockets": self._count_sockets("UDP"),
            "tcp_connections": self._count_sockets("TCP"),
            **_read_load(),
            "process_uptime_s": round(now_s - self._started_s, 1),
            "board_uptime_s": _read_board_uptime_s(),
        }
        return HealthReading(cpus=_read_cpus(), values=values)

    def _read_temperature(self) -> float | None:
        text = _read_text(self._temperature_file)
        try:
            return int(text) / 1000 if text else None
        except ValueError:
            return None

    def _read_throttled(self) -> int | None:
        text = _read_text(self._throttled_file)
        return parse_throttled(text) if text else None

    def _count_sockets(self, protocol: str) -> int | None:
        """
        Return the open sockets of both address families, protocol UDP or TCP.

        From the kernel's own counts: the lists in /proc/net/tcp take 8 ms to walk, however few they hold,
        and psutil looks at every process's descriptors besides.
        """
        text = (_read_text(self._proc_net / "sockstat") or "") + (
            _read_text(self._proc_net / "sockstat6") or ""
        )
        counts = [
            int(words[2])
            for words in (line.split() for line in text.splitlines())
            if words[:2] in ([f"{protocol}:", "inuse"], [f"{protocol}6:", "inuse"])
        ]
        return sum(counts) if counts else None


class ProcessUsage:
    """Use of resources by this process; the share of CPU is between one call and the next."""

    def __init__(self) -> None:
        self._wall_s = time.monotonic()
        self._cpu_s = time.process_time()

    def read(
        self, t_s: float | None = None
    ) -> tuple[float | None, float, int | None, int, int, int]:
        """
        Return one record of the PROCESS stream.

        Args:
            t_s: Simulated time, s.

        Returns:
            t_s, CPU % since the last call (100 is one processor), resident bytes, and since the
            process's start major faults, voluntary and involuntary switches.
        """
        wall_s, cpu_s = time.monotonic(), time.process_time()
        elapsed_s = wall_s - self._wall_s
        percent = 100.0 * (cpu_s - self._cpu_s) / elapsed_s if elapsed_s > 0 else 0.0
        self._wall_s, self._cpu_s = wall_s, cpu_s
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return (
            t_s,
            round(percent, 2),
            _read_rss_bytes(),
            usage.ru_majflt,
            usage.ru_nvcsw,
            usage.ru_nivcsw,
        )


def pss_bytes(pid: int) -> int | None:
    """Return a process's proportional share of memory; None if it is gone or may not be looked at."""
    text = _read_text(Path(f"/proc/{pid}/smaps_rollup"))
    for line in (text or "").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    return None


def _find_temperature_file(root: Path) -> Path | None:
    zones: dict[str, Path] = {}
    for zone in sorted(root.glob(THERMAL_ZONES)):
        kind = (_read_text(zone / "type") or "").strip()
        zones.setdefault(kind, zone / "temp")
    return next((zones[kind] for kind in (*CPU_ZONE_TYPES, *zones) if kind in zones), None)


def _find_throttled_file(root: Path) -> Path | None:
    found = (sorted(root.glob(f"{pattern}/get_throttled")) for pattern in THROTTLED_FILES)
    return next((path for paths in found for path in paths), None)


def _read_text(path: Path | None) -> str | None:
    try:
        return path.read_text(encoding="ascii", errors="replace") if path else None
    except OSError:
        return None


def _read_cpus() -> tuple[CpuTimes, ...]:
    cpus = []
    for times in psutil.cpu_times(percpu=True):
        # A guest's time is in user time as well; counted twice it would make the total too large.
        guest_s = getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)
        total_s = sum(times) - guest_s
        idle_s = times.idle + getattr(times, "iowait", 0.0)
        cpus.append(CpuTimes(busy_s=total_s - idle_s, total_s=total_s))
    return tuple(cpus)


def _read_disk_space(directory: Path) -> dict[str, Any]:
    try:
        usage = psutil.disk_usage(str(directory))
    except OSError:
        return {}
    return {
        "disk_total_bytes": usage.total,
        "disk_used_bytes": usage.used,
        "disk_free_bytes": usage.free,  # what this user may still fill
        "disk_percent": usage.percent,
    }


def _read_disk() -> dict[str, Any]:
    """Return the counters of all disks together, since the machine's start."""
    try:
        counters = psutil.disk_io_counters()
    except (OSError, RuntimeError, NotImplementedError):
        counters = None
    if counters is None:
        return {}
    return {
        "disk_reads": counters.read_count,
        "disk_writes": counters.write_count,
        "disk_read_bytes": counters.read_bytes,
        "disk_written_bytes": counters.write_bytes,
        "disk_read_time_ms": counters.read_time,
        "disk_write_time_ms": counters.write_time,
    }


def _read_network() -> dict[str, Any]:
    """Return the counters of all interfaces but loopback together, since they came up."""
    try:
        by_interface = psutil.net_io_counters(pernic=True)
    except OSError:
        return {}
    real = [counters for name, counters in by_interface.items() if name != "lo"]
    loopback = by_interface.get("lo")
    return {
        "network_sent_bytes": sum(c.bytes_sent for c in real),
        "network_received_bytes": sum(c.bytes_recv for c in real),
        "network_sent_packets": sum(c.packets_sent for c in real),
        "network_received_packets": sum(c.packets_recv for c in real),
        "network_errors": sum(c.errin + c.errout for c in real),
        "network_drops": sum(c.dropin + c.dropout for c in real),
        "loopback_bytes": loopback.bytes_sent if loopback else 0,
    }


def _read_load() -> dict[str, Any]:
    try:
        return dict(zip(("load_1min", "load_5min", "load_15min"), os.getloadavg(), strict=True))
    except OSError:
        return {}


def _read_board_uptime_s() -> float | None:
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return None
    return round(time.clock_gettime(time.CLOCK_BOOTTIME), 1)


def _read_rss_bytes() -> int | None:
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        return None
