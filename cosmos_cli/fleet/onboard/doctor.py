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
from typing import Any

from cosmos_cli.fleet.onboard.busy import compare, look
from cosmos_cli.fleet.onboard.core import Request, verb
from cosmos_cli.fleet.onboard.facts import facts
from cosmos_cli.fleet.onboard.interfaces import interfaces, receive_drops
from cosmos_cli.fleet.onboard.processes import processes
from cosmos_cli.fleet.onboard.round_trips import round_trips
from cosmos_cli.fleet.onboard.wakeups import wake_ups

WRITE_BYTES = 1024 * 1024
NAMES_MAX = 50
WHOLE_MARK = ".complete"
SYNCHRONIZED = "/run/systemd/timesync/synchronized"
CONTAINER_MARKS = ("/.dockerenv", "/run/.containerenv", "/run/systemd/container")


@verb("doctor")
def doctor(request: Request) -> dict[str, Any]:
    """
    Look at everything; takes about as long as the wake-ups that are measured.

    Args:
        request: "wake_ups" (count, rate_hz, policy, priority) and "round_trips" (address, port,
            nonce_hex, count), each null to leave it out; "root", "runs", "environments" and "state", the
            folders of COSMoS here; "interface", where the one that the operator came by is not the one
            that matters; "etc", "sys" and "proc", where others than the system's are meant.
    """
    asked = request.arguments
    sys_, proc = (asked.get(key) or f"/{key}" for key in ("sys", "proc"))
    told: dict[str, Any] = {
        "facts": facts(
            Request(
                arguments={**_only(asked, ("root", "etc", "sys", "proc")), "sudo": True}, body=b""
            )
        )
    }
    connected = asked.get("interface") or told["facts"]["network"].get("interface")
    drops_before, interfaces_before = receive_drops(proc), interfaces(sys_, connected)
    before = look(proc)
    told["wake_ups"] = wake_ups(**asked["wake_ups"]) if asked.get("wake_ups") else None
    told["busy"] = compare(before, look(proc))
    trips = asked.get("round_trips")
    told["round_trips"] = _round_trips(trips) if trips else None
    told["kernel"] = _kernel(sys_, proc)
    told["limits"] = _limits(proc)
    told["swap"] = _swap(proc)
    told["interfaces"] = interfaces(sys_, connected, interfaces_before)
    told["receive_drops"] = {"total": receive_drops(proc), "before": drops_before}
    told["disk_write"] = _disk_write(told["facts"]["disk"])
    told["cosmos"] = _cosmos(asked)
    return told


def _only(asked: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    return {key: asked[key] for key in keys if asked.get(key)}


def _round_trips(asked: Mapping[str, Any]) -> dict[str, Any]:
    nonce = bytes.fromhex(asked["nonce_hex"])
    return round_trips(asked["address"], int(asked["port"]), nonce, int(asked["count"]))


def _text(path: str) -> str | None:
    try:
        with open(path) as file:
            return file.read(65_536).strip()
    except (OSError, ValueError):
        return None


def _number(path: str) -> int | None:
    with contextlib.suppress(TypeError, ValueError):
        return int(_text(path))  # type: ignore[arg-type]
    return None


def _kernel(sys_: str, proc: str) -> dict[str, Any]:
    return {
        "realtime_runtime_us": _number(f"{proc}/sys/kernel/sched_rt_runtime_us"),
        "realtime_period_us": _number(f"{proc}/sys/kernel/sched_rt_period_us"),
        "timer_resolution_s": time.clock_getres(time.CLOCK_MONOTONIC),
        "clock_source": _text(
            f"{sys_}/devices/system/clocksource/clocksource0/current_clocksource"
        ),
        "is_clock_synchronized": os.path.exists(SYNCHRONIZED),
    }


def _limits(proc: str) -> dict[str, Any]:
    capabilities = 0
    for line in (_text(f"{proc}/self/status") or "").splitlines():
        if line.startswith("CapEff:"):
            capabilities = int(line.split()[1], 16)
    return {
        "capabilities": capabilities,
        "usable_processors": len(os.sched_getaffinity(0)),
        "processor_numbers": sorted(os.sched_getaffinity(0)),
        "cpu_quota": _cpu_quota(
            sys_cgroup="/sys/fs/cgroup", own=_text(f"{proc}/self/cgroup") or ""
        ),
        "is_container": any(os.path.exists(mark) for mark in CONTAINER_MARKS),
    }


def _cpu_quota(sys_cgroup: str, own: str) -> float | None:
    """Return how many processors this control group or one above it may use; None for no limit."""
    path = next((line[3:] for line in own.splitlines() if line.startswith("0::")), "/")
    quotas = []
    while True:
        words = (_text(f"{sys_cgroup}{path.rstrip('/')}/cpu.max") or "max").split()
        if len(words) == 2 and words[0].isdecimal() and words[1].isdecimal():
            quotas.append(int(words[0]) / int(words[1]))
        if path in ("/", ""):
            return min(quotas, default=None)
        path = os.path.dirname(path)


def _swap(proc: str) -> dict[str, int | None]:
    values = {}
    for line in (_text(f"{proc}/meminfo") or "").splitlines():
        key, _, value = line.partition(":")
        if value.endswith(" kB"):
            values[key] = int(value[:-3]) * 1024
    total, free = values.get("SwapTotal"), values.get("SwapFree")
    used = None if total is None or free is None else total - free
    return {"total_bytes": total, "used_bytes": used}


def _disk_write(disk: Mapping[str, Any]) -> dict[str, Any] | None:
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


def _cosmos(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Tell what COSMoS left or runs here."""
    environments = os.path.expanduser(str(asked.get("environments") or ""))
    return {
        "has_root": os.path.isdir(os.path.expanduser(asked.get("root") or "/")),
        "living": processes(Request(arguments={"state": asked["state"]}, body=b"")),
        "runs": _names(asked.get("runs")),
        "environments": [
            {"name": name, "is_whole": os.path.exists(f"{environments}/{name}/{WHOLE_MARK}")}
            for name in _names(asked.get("environments"))
        ],
    }


def _names(folder: str | None) -> list[str]:
    """Return the folders in a folder, the oldest first."""
    if folder is None:
        return []
    found = []
    with contextlib.suppress(OSError), os.scandir(os.path.expanduser(folder)) as entries:
        found = [
            (entry.stat(follow_symlinks=False).st_mtime, entry.name)
            for entry in entries
            if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
        ]
    return [name for _, name in sorted(found)][-NAMES_MAX:]
