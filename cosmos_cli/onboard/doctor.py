"""
All that may spoil real time or a run on a machine, looked at and measured in one request.

Nothing is judged here, and nothing is changed: a file for the disk's test is gone before it is written.
What cannot be read is null.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Mapping

from cosmos_cli.onboard.cpu_load import compare, look
from cosmos_cli.onboard.facts import facts
from cosmos_cli.onboard.interfaces import interfaces, receive_drops
from cosmos_cli.onboard.links import kilobyte_sizes, read_number, read_text
from cosmos_cli.onboard.processes import processes
from cosmos_cli.onboard.request_loop import PlainValue, VerbRequest, verb
from cosmos_cli.onboard.timer_latency import wake_ups
from cosmos_cli.onboard.udp_probe import round_trips_to

WRITE_BYTES = 1024 * 1024
NAMES_MAX = 50
WHOLE_MARK = ".complete"
SYNCHRONIZED = "/run/systemd/timesync/synchronized"
CONTAINER_MARKS = ("/.dockerenv", "/run/.containerenv", "/run/systemd/container")


@verb("doctor")
def doctor(request: VerbRequest) -> dict[str, PlainValue]:
    """
    Look at everything; takes about as long as the wake-ups that are measured.

    Args:
        request: "sudo", whether it may be asked; "wake_ups" (count, rate_hz, policy, priority) and "round_trips" (address, port,
            nonce_hex, count), each null to leave it out; "root", "runs", "environments" and "state", the
            folders of COSMoS here; "interface", where the one that the operator came by is not the one
            that matters; "etc", "sys" and "proc", where others than the system's are meant.
    """
    asked = request.arguments
    sys_, proc = (asked.get(key) or f"/{key}" for key in ("sys", "proc"))
    named = {key: asked[key] for key in ("root", "etc", "sys", "proc") if asked.get(key)}
    found = facts(VerbRequest(arguments={**named, "sudo": bool(asked.get("sudo"))}))
    connected = asked.get("interface") or found["network"].get("interface")
    drops_before, interfaces_before = receive_drops(proc), interfaces(sys_, connected)
    before = look(proc)
    trips = asked.get("round_trips")
    return {
        "facts": found,
        "wake_ups": wake_ups(**asked["wake_ups"]) if asked.get("wake_ups") else None,
        "busy": compare(before, look(proc)),
        "round_trips": round_trips_to(VerbRequest(arguments=trips)) if trips else None,
        "kernel": _kernel(sys_, proc),
        "limits": _limits(proc),
        "swap": _swap(proc),
        "interfaces": interfaces(sys_, connected, interfaces_before),
        "receive_drops": {"total": receive_drops(proc), "before": drops_before},
        "disk_write": _disk_write(found["disk"]),
        "cosmos": _cosmos(asked),
    }


def _kernel(sys_: str, proc: str) -> dict[str, PlainValue]:
    return {
        "realtime_runtime_us": read_number(f"{proc}/sys/kernel/sched_rt_runtime_us"),
        "realtime_period_us": read_number(f"{proc}/sys/kernel/sched_rt_period_us"),
        "timer_resolution_s": time.clock_getres(time.CLOCK_MONOTONIC),
        "clock_source": read_text(
            f"{sys_}/devices/system/clocksource/clocksource0/current_clocksource"
        ),
        "is_clock_synchronized": os.path.exists(SYNCHRONIZED),
    }


def _limits(proc: str) -> dict[str, PlainValue]:
    lines = (read_text(f"{proc}/self/status") or "").splitlines()
    effective = (int(line.split()[1], 16) for line in lines if line.startswith("CapEff:"))
    return {
        "capabilities": next(effective, 0),
        "usable_processors": len(os.sched_getaffinity(0)),
        "processor_numbers": sorted(os.sched_getaffinity(0)),
        "cpu_quota": _cpu_quota("/sys/fs/cgroup", read_text(f"{proc}/self/cgroup") or ""),
        "is_container": any(os.path.exists(mark) for mark in CONTAINER_MARKS),
    }


def _cpu_quota(sys_cgroup: str, own: str) -> float | None:
    """Return how many processors this control group or one above it may use; None for no limit."""
    path = next((line[3:] for line in own.splitlines() if line.startswith("0::")), "/")
    quotas = []
    while True:
        words = (read_text(f"{sys_cgroup}{path.rstrip('/')}/cpu.max") or "max").split()
        if len(words) == 2 and words[0].isdecimal() and words[1].isdecimal():
            quotas.append(int(words[0]) / int(words[1]))
        if path in ("/", ""):
            return min(quotas, default=None)
        path = os.path.dirname(path)


def _swap(proc: str) -> dict[str, int | None]:
    values = kilobyte_sizes(f"{proc}/meminfo")
    total, free = values.get("SwapTotal"), values.get("SwapFree")
    used = None if total is None or free is None else total - free
    return {"total_bytes": total, "used_bytes": used}


def _disk_write(disk: Mapping[str, PlainValue]) -> dict[str, PlainValue] | None:
    """Write and synchronise one megabyte, then a little more, where runs would record."""
    if disk.get("is_read_only") or not disk.get("is_writable"):
        return None
    try:
        with tempfile.TemporaryFile(dir=disk["path"], buffering=0) as file:
            start_s = time.monotonic()
            file.write(os.urandom(4096) * (WRITE_BYTES // 4096))
            os.fsync(file.fileno())
            first_s = time.monotonic()
            file.write(b"x" * 4096)
            os.fsync(file.fileno())
            end_s = time.monotonic()
    except OSError as error:
        return {"error": error.strerror or str(error), "errno": error.errno}
    return {
        "bytes": WRITE_BYTES,
        "duration_s": first_s - start_s,
        "sync_s": end_s - first_s,
    }


def _cosmos(asked: Mapping[str, PlainValue]) -> dict[str, PlainValue]:
    """Tell what COSMoS left or runs here."""
    environments = os.path.expanduser(str(asked.get("environments") or ""))
    runs = _names(str(asked.get("runs") or ""))
    return {
        "has_root": os.path.isdir(os.path.expanduser(asked.get("root") or "/")),
        "living": processes(VerbRequest(arguments={"state": asked["state"]})),
        "runs": runs[-NAMES_MAX:],
        "run_count": len(runs),
        "environments": [
            {"name": name, "is_whole": os.path.exists(f"{environments}/{name}/{WHOLE_MARK}")}
            for name in _names(environments)[-NAMES_MAX:]
        ],
    }


def _names(folder: str) -> list[str]:
    """Return the folders in a folder, the oldest first."""
    with contextlib.suppress(OSError), os.scandir(os.path.expanduser(folder)) as entries:
        found = [
            (entry.stat(follow_symlinks=False).st_mtime, entry.name)
            for entry in entries
            if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
        ]
        return [name for _, name in sorted(found)]
    return []
