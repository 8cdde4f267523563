"""
What a machine is like, found out in one request; nothing is changed.

Besides what is always told, the request names what the plan of `cosmos up` needs to know: files, packages,
services, and conditions of commands. What cannot be read is null; only what cannot be asked is refused.
Every path begins with one of the folders that the request gives for /etc, /sys and /proc.
"""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence

from cosmos_cli.fleet.onboard.core import Refusal, Request, handler_of, refusal_of, verb
from cosmos_cli.fleet.onboard.files import content_hash, look_at
from cosmos_cli.fleet.onboard.links import (
    TEXT_BYTES_MAX,
    names_in,
    network,
    read_number,
    read_text,
)

TYPE_CHECKING = False  # to import typing takes longer than most that is done here
if TYPE_CHECKING:
    from typing import Any

CONDITION_TIMEOUT_S = 60.0
SUDO_TIMEOUT_S = 20.0
TOOL_TIMEOUT_S = 5.0
TIMED_OUT_STATUS = 124
"""Of `timeout`, which root's process heeds; a signal of ours it would not."""
THROTTLED = "devices/platform/soc/soc:firmware/get_throttled"
READ_ONLY = os.ST_RDONLY


@verb("several")
def several(request: Request) -> list[dict[str, Any]]:
    """Do several requests in one frame; a refusal of one is its answer, and the others are done."""
    answers: list[dict[str, Any]] = []
    for call in request.arguments["calls"]:
        try:
            value = handler_of(call["verb"])(
                Request(arguments=call.get("arguments") or {}, body=b"")
            )
            answers.append({"ok": True, "value": value})
        except (Refusal, OSError) as error:
            refusal = refusal_of(error) if isinstance(error, OSError) else error
            told = {"kind": refusal.kind, "text": refusal.text, "advice": refusal.advice}
            answers.append({"ok": False, "error": told})
    return answers


@verb("facts")
def facts(request: Request) -> dict[str, Any]:
    """Tell what the machine is like, and what the plan asks for."""
    asked = request.arguments
    etc, sys_, proc = (asked.get(key) or f"/{key}" for key in ("etc", "sys", "proc"))
    is_sudo_asked = bool(asked.get("sudo"))
    sudo = _start_sudo() if is_sudo_asked else None
    told: dict[str, Any] = {
        "user": _user(),
        "board": _board(sys_),
        "os": _release(etc),
        "python": _python(),
        "clock": _clock(proc),
        "disk": _disk(asked.get("root") or "/"),
        "memory": _memory(proc),
        "temperature_c": _scaled(f"{sys_}/class/thermal/thermal_zone0/temp", 1000),
        "throttled": _throttled(sys_),
        "network": network(proc, sys_),
        "realtime_priority_max": _limit(resource.RLIMIT_RTPRIO),
        "memory_lock_bytes_max": _limit(resource.RLIMIT_MEMLOCK),
        "governors": _governors(sys_),
        "governors_available": (
            read_text(f"{sys_}/devices/system/cpu/cpu0/cpufreq/scaling_available_governors") or ""
        ).split(),
        "radios": _radios(sys_),
        "files": _files(asked),
        "services": {name: _service(name) for name in asked.get("services") or ()},
        "conditions": _conditions(asked),
        "packages": _packages(asked.get("packages") or ()),
    }
    told["sudo"] = _end_sudo(sudo) if is_sudo_asked else None
    return told


@verb("look")
def look(request: Request) -> dict[str, Any]:
    """Tell of files and conditions alone: as root, what the user is not shown."""
    asked = request.arguments
    return {
        "files": _files(asked),
        "conditions": _conditions(asked),
    }


def _scaled(path: str, divisor: int) -> float | None:
    number = read_number(path)
    return None if number is None else number / divisor


def _user() -> dict[str, Any]:
    import pwd

    uid = os.geteuid()
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = str(uid)
    return {"name": name, "id": uid, "home": os.path.expanduser("~")}


def _board(sys_: str) -> dict[str, Any]:
    system = os.uname()
    return {
        "model": read_text(f"{sys_}/firmware/devicetree/base/model")
        or read_text(f"{sys_}/class/dmi/id/product_name"),
        "machine": system.machine,
        "bits": 64 if sys.maxsize > 2**32 else 32,
        "node": system.nodename,
        "kernel": system.release,
        "processors": os.cpu_count(),
    }


def _release(etc: str) -> dict[str, str]:
    values = {}
    for line in (read_text(f"{etc}/os-release") or "").splitlines():
        key, _, value = line.partition("=")
        values[key] = value.strip("\"'")
    wanted = {
        "id": "ID",
        "version": "VERSION_ID",
        "name": "PRETTY_NAME",
        "code": "VERSION_CODENAME",
    }
    return {key: values.get(name, "") for key, name in wanted.items()}


def _python() -> dict[str, Any]:
    folder = os.path.dirname(os.__file__)
    libc = ""
    with contextlib.suppress(OSError, ValueError):
        libc = os.confstr("CS_GNU_LIBC_VERSION") or ""
    return {
        "version": list(sys.version_info[:3]),
        "executable": sys.executable,
        "libc": libc,
        "has_venv": os.path.isdir(f"{folder}/venv"),
        "has_ensurepip": os.path.isdir(f"{folder}/ensurepip"),
    }


def _clock(proc: str) -> dict[str, Any]:
    uptime = (read_text(f"{proc}/uptime") or "").split()
    return {
        "utc_s": time.clock_gettime(time.CLOCK_REALTIME),
        "uptime_s": float(uptime[0]) if uptime else None,
        "boot_id": read_text(f"{proc}/sys/kernel/random/boot_id"),
    }


def _disk(root: str) -> dict[str, Any]:
    """Tell of the file system on which *root* is, or will be."""
    path = os.path.abspath(os.path.expanduser(root))
    while not os.path.lexists(path) and path != "/":
        path = os.path.dirname(path)
    found = os.statvfs(path)
    return {
        "path": path,
        "total_bytes": found.f_blocks * found.f_frsize,
        "free_bytes": found.f_bavail * found.f_frsize,
        "free_files": found.f_favail if found.f_files else None,
        "is_read_only": bool(found.f_flag & READ_ONLY),
        "is_writable": os.access(path, os.W_OK | os.X_OK),
    }


def _memory(proc: str) -> dict[str, int | None]:
    values = {}
    for line in (read_text(f"{proc}/meminfo") or "").splitlines():
        key, _, value = line.partition(":")
        if value.endswith(" kB"):
            values[key] = int(value[:-3]) * 1024
    return {"total_bytes": values.get("MemTotal"), "available_bytes": values.get("MemAvailable")}


def _throttled(sys_: str) -> int | None:
    """Return the bits of a Raspberry Pi's firmware: from the kernel, else from its tool."""
    number = read_number(f"{sys_}/{THROTTLED}", 16)
    if number is not None:
        return number
    for tool in ("/usr/bin/vcgencmd", "/opt/vc/bin/vcgencmd", "/usr/local/bin/vcgencmd"):
        if os.access(tool, os.X_OK):
            said = _output([tool, "get_throttled"], TOOL_TIMEOUT_S)
            with contextlib.suppress(ValueError):
                return int(said.strip().rpartition("=")[2], 16)
    return None


def _output(command: list[str], timeout_s: float) -> str:
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout_s, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.decode(errors="replace")


def _limit(which: int) -> int | None:
    """Return the limit up to which this login may go; None for no limit."""
    hard = resource.getrlimit(which)[1]
    return None if hard == resource.RLIM_INFINITY else hard


def _governors(sys_: str) -> dict[str, str]:
    found = {}
    for name in sorted(names_in(f"{sys_}/devices/system/cpu")):
        governor = read_text(f"{sys_}/devices/system/cpu/{name}/cpufreq/scaling_governor")
        if governor is not None and name[3:].isdecimal():  # the others are not processors
            found[name] = governor
    return found


def _radios(sys_: str) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "type": read_text(f"{sys_}/class/rfkill/{name}/type") or "",
            "is_soft_blocked": read_text(f"{sys_}/class/rfkill/{name}/soft") == "1",
            "is_hard_blocked": read_text(f"{sys_}/class/rfkill/{name}/hard") == "1",
        }
        for name in sorted(names_in(f"{sys_}/class/rfkill"))
    ]


def _files(asked: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    return {path: _file(path, how) for path, how in (asked.get("files") or {}).items()}


def _file(path: str, how: str) -> dict[str, Any]:
    """
    Tell of one path: what it is, its mode and owner; *how* "hash" adds its content's hash, "text" the content.

    A content that is too long for a text comes without it.
    """
    try:
        told = look_at(path)
        if told["kind"] == "file" and how in ("hash", "text"):
            told["sha256"] = content_hash(path)
            if how == "text" and told["size_bytes"] <= TEXT_BYTES_MAX:
                with open(os.path.expanduser(path), "rb") as file:
                    told["text"] = file.read().decode(errors="surrogateescape")
    except PermissionError:
        return {"kind": "denied"}
    return told


def _packages(names: Sequence[str]) -> dict[str, str | None]:
    """Tell the installed version of each package; what changes packages is in `apt`, and is heavier."""
    layout = "${Package} ${Architecture} ${db:Status-Status} ${Version}\\n"
    said = _output(["dpkg-query", "-W", f"-f={layout}", *names], TOOL_TIMEOUT_S) if names else ""
    found: dict[str, str] = {}
    for line in said.splitlines():
        words = line.split(" ")
        if len(words) == 4 and words[2] == "installed":
            found.setdefault(words[0], words[3])
            found[f"{words[0]}:{words[1]}"] = words[3]
    return {name: found.get(name) for name in names}


def _service(name: str) -> dict[str, str]:
    asks = {"enabled": "is-enabled", "active": "is-active"}
    return {
        key: _output(["systemctl", ask, name], TOOL_TIMEOUT_S).strip() or "unknown"
        for key, ask in asks.items()
    }


def _conditions(asked: Mapping[str, Any]) -> dict[str, bool | None]:
    wanted = asked.get("conditions") or {}
    return {key: _condition(condition) for key, condition in wanted.items()}


def _condition(condition: Mapping[str, Any]) -> bool | None:
    """Tell whether a command is done already; None when only root can say."""
    path = condition.get("creates")
    if path is None:
        return is_done(condition["unless"], as_root=bool(condition.get("root")))
    try:
        os.lstat(os.path.expanduser(path))
    except PermissionError:
        return None
    except OSError:
        return False
    return True


def is_done(unless: str, *, as_root: bool) -> bool:
    """Tell whether a command's condition succeeds; one that may not be asked as root does not."""
    shell = ["timeout", f"{CONDITION_TIMEOUT_S:g}", "/bin/sh", "-c", unless]
    done = subprocess.run(
        ["sudo", "-n", *shell] if as_root and os.geteuid() != 0 else shell,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    if done.returncode == TIMED_OUT_STATUS:
        raise Refusal("timeout", f"unless: {unless}: not done in {CONDITION_TIMEOUT_S:g} s")
    return done.returncode == 0


def _start_sudo() -> subprocess.Popen[bytes] | None:
    """Ask whether this user may become root, and go on meanwhile; None for root itself."""
    if os.geteuid() == 0:
        return None
    with contextlib.suppress(OSError):
        return subprocess.Popen(
            ["sudo", "-n", "true"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    return None


def _end_sudo(sudo: subprocess.Popen[bytes] | None) -> bool:
    if sudo is None:
        return os.geteuid() == 0
    with contextlib.suppress(subprocess.TimeoutExpired):
        return sudo.wait(SUDO_TIMEOUT_S) == 0
    return False
