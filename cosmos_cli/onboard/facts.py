"""
Facts of a machine, gathered in one request; nothing is changed.

Besides what is always told, the request names what the plan of `cosmos up` needs to know: files, packages,
services, and conditions of commands. What cannot be read is null; only what cannot be asked is refused.
Every path begins with one of the folders that the request gives for /etc, /sys and /proc.
"""

from __future__ import annotations

import contextlib
import os
import resource
import sys
import time
import zlib
from collections.abc import Mapping, Sequence

from cosmos_cli.onboard.dpkg import installed_versions
from cosmos_cli.onboard.files import content_hash, look_at, user_name
from cosmos_cli.onboard.links import (
    TEXT_BYTES_MAX,
    kilobyte_sizes,
    names_in,
    network,
    read_number,
    read_text,
)
from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    handler_of,
    last_words,
    libc_version,
    refusal_of,
    verb,
)

TYPE_CHECKING = False  # to import typing takes longer than most that is done here
if TYPE_CHECKING:
    import subprocess

CONDITION_TIMEOUT_S = 60.0
SUDO_TIMEOUT_S = 20.0
SUDO_POLL_S = 0.005
SUDO_BYTES_MAX = 4096
TOOL_TIMEOUT_S = 5.0
TIMED_OUT_STATUS = 124
"""Of `timeout`, which root's process heeds; a signal of ours it would not."""
THROTTLED = "devices/platform/soc/soc:firmware/get_throttled"
READ_ONLY, NO_PROGRAMS = os.ST_RDONLY, os.ST_NOEXEC
PROCESSOR_KEYS = (
    *(b"vendor_id", b"model name", b"flags"),
    *(b"Features", b"CPU implementer", b"CPU architecture", b"CPU variant", b"CPU part"),
)
"""Of /proc/cpuinfo: what tells processors of an x86-64 and of an ARM computer apart."""


@verb("several")
def several(request: VerbRequest) -> list[dict[str, PlainValue]]:
    """Do several requests in one frame; a refusal of one is its answer, and the others are done."""
    answers: list[dict[str, PlainValue]] = []
    for call in request.arguments["calls"]:
        try:
            value = handler_of(call["verb"])(VerbRequest(arguments=call.get("arguments") or {}))
            answers.append({"ok": True, "value": value})
        except (HelperRefusal, OSError) as error:
            answers.append({"ok": False, "error": refusal_of(error).to_mapping()})
    return answers


@verb("facts")
def facts(request: VerbRequest) -> dict[str, PlainValue]:
    """Tell what the machine is like, and what the plan asks for."""
    asked = request.arguments
    etc, sys_, proc = (asked.get(key) or f"/{key}" for key in ("etc", "sys", "proc"))
    is_sudo_asked = bool(asked.get("sudo"))
    sudo = _start_sudo() if is_sudo_asked else None
    return {
        "user": _user(),
        "board": _board(sys_, proc),
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
        "uses_pam": _uses_pam(etc) if asked.get("is_pam_asked") else None,
        "services": {name: service_state(name) for name in asked.get("services") or ()},
        "stale_units": [name for name in asked.get("units") or () if _is_stale(name)],
        **look(request),
        "packages": installed_versions(asked.get("packages") or (), _output),
        **(_end_sudo(sudo) if is_sudo_asked else {"sudo": None, "sudo_refusal": None}),
    }


@verb("look")
def look(request: VerbRequest) -> dict[str, PlainValue]:
    """Tell of files and conditions alone: as root, what the user is not shown."""
    files = request.arguments.get("files") or {}
    conditions = request.arguments.get("conditions") or {}
    return {
        "files": {path: _file(path, how) for path, how in files.items()},
        "conditions": {key: _condition(condition) for key, condition in conditions.items()},
    }


def _scaled(path: str, divisor: int) -> float | None:
    number = read_number(path)
    return None if number is None else number / divisor


def _user() -> dict[str, PlainValue]:
    uid = os.geteuid()
    return {"name": user_name(uid), "id": uid, "home": os.path.expanduser("~")}


def _board(sys_: str, proc: str) -> dict[str, PlainValue]:
    system = os.uname()
    return {
        "model": read_text(f"{sys_}/firmware/devicetree/base/model")
        or read_text(f"{sys_}/class/dmi/id/product_name"),
        "machine": system.machine,
        "bits": 64 if sys.maxsize > 2**32 else 32,
        "node": system.nodename,
        "kernel": system.release,
        "processors": os.cpu_count(),
        "is_preempt_rt": is_preempt_rt(sys_, proc),
        "processor_kind": _processor_kind(proc),
    }


def _processor_kind(proc: str) -> str | None:
    """Return a word that processors of the same kind and abilities share; None where the kernel does not tell."""
    found: set[tuple[bytes, bytes]] = set()
    with contextlib.suppress(OSError), open(f"{proc}/cpuinfo", "rb") as file:
        for line in file:
            if not line.strip() and found:
                break  # the next processor
            key, _, value = line.partition(b":")
            if key.strip() in PROCESSOR_KEYS:
                found.add((key.strip(), value.strip()))
    return f"{zlib.crc32(repr(sorted(found)).encode()):08x}" if found else None


def is_preempt_rt(sys_: str, proc: str) -> bool | None:
    """Tell whether the kernel is PREEMPT_RT: by its own file, which only such a one has, else by its version; None if unknown."""
    if read_number(f"{sys_}/kernel/realtime") == 1:
        return True
    version = read_text(f"{proc}/version")
    return None if version is None else "PREEMPT_RT" in version or "PREEMPT RT" in version


def _release(etc: str) -> dict[str, str]:
    rows = (line.partition("=") for line in (read_text(f"{etc}/os-release") or "").splitlines())
    values = {key: value.strip("\"'") for key, _, value in rows}
    wanted = {
        "id": "ID",
        "version": "VERSION_ID",
        "name": "PRETTY_NAME",
        "code": "VERSION_CODENAME",
    }
    return {key: values.get(name, "") for key, name in wanted.items()}


def _python() -> dict[str, PlainValue]:
    return {
        "version": list(sys.version_info[:3]),
        "executable": sys.executable,
        "libc": libc_version(),
    }


def _clock(proc: str) -> dict[str, PlainValue]:
    uptime = (read_text(f"{proc}/uptime") or "").split()
    return {
        "utc_s": time.clock_gettime(time.CLOCK_REALTIME),
        "uptime_s": float(uptime[0]) if uptime else None,
        "boot_id": read_text(f"{proc}/sys/kernel/random/boot_id"),
    }


def _disk(root: str) -> dict[str, PlainValue]:
    """Tell of the file system on which *root* is, or will be; a link to a disk that is not mounted is refused."""
    path = os.path.abspath(os.path.expanduser(root))
    while not os.path.lexists(path) and path != "/":
        path = os.path.dirname(path)
    try:
        found = os.statvfs(path)
    except FileNotFoundError:
        text = f"{path}: a link that leads nowhere ({os.path.realpath(path)})"
        raise HelperRefusal("step", text, "mount what it leads to, or remove the link") from None
    return {
        "path": path,
        "total_bytes": found.f_blocks * found.f_frsize,
        "free_bytes": found.f_bavail * found.f_frsize,
        "free_files": found.f_favail if found.f_files else None,
        "is_read_only": bool(found.f_flag & READ_ONLY),
        "is_writable": os.access(path, os.W_OK | os.X_OK),
        "is_noexec": bool(found.f_flag & NO_PROGRAMS),
    }


def _memory(proc: str) -> dict[str, int | None]:
    values = kilobyte_sizes(f"{proc}/meminfo")
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


def _output(command: Sequence[str], timeout_s: float) -> str:
    """Return what a program prints in English; nothing of one that is not there or came to no end."""
    return _run(command, timeout_s, {"LC_ALL": "C"})[1].decode(errors="replace")


def _run(
    command: Sequence[str], timeout_s: float, variables: Mapping[str, str]
) -> tuple[int | None, bytes]:
    """Return a command's exit code and what it printed; None and nothing for one that never began or came to no end."""
    import subprocess  # 8 ms, which most looks need not wait for

    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout_s,
            env={**os.environ, **variables},
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None, b""
    return done.returncode, done.stdout


def _limit(which: int) -> int | None:
    """Return the limit up to which this login may go; None for no limit."""
    hard = resource.getrlimit(which)[1]
    return None if hard == resource.RLIM_INFINITY else hard


def _governors(sys_: str) -> dict[str, str]:
    folder = f"{sys_}/devices/system/cpu"
    found = {
        name: read_text(f"{folder}/{name}/cpufreq/scaling_governor")
        for name in sorted(names_in(folder))
        if name[3:].isdecimal()  # the others are not processors
    }
    return {name: governor for name, governor in found.items() if governor is not None}


def _radios(sys_: str) -> list[dict[str, PlainValue]]:
    return [
        {
            "name": name,
            "type": read_text(f"{sys_}/class/rfkill/{name}/type") or "",
            "is_soft_blocked": read_text(f"{sys_}/class/rfkill/{name}/soft") == "1",
            "is_hard_blocked": read_text(f"{sys_}/class/rfkill/{name}/hard") == "1",
        }
        for name in sorted(names_in(f"{sys_}/class/rfkill"))
    ]


def _uses_pam(etc: str) -> bool | None:
    from cosmos_cli.onboard.sshd import uses_pam  # most commands need it not

    return uses_pam(etc)


def _file(path: str, how: str) -> dict[str, PlainValue]:
    """
    Tell of one path: what it is, its mode and owner; *how* "hash" adds its content's hash, "text" the content.

    A content that is too long for a text comes without it, and one that is longer than any that is written without hash.
    """
    try:
        told = look_at(path)
        if told["kind"] == "file" and how in ("hash", "text"):
            sha256 = content_hash(path)
            if sha256 is not None:
                told["sha256"] = sha256
            if how == "text" and told["size_bytes"] <= TEXT_BYTES_MAX:
                with open(os.path.expanduser(path), "rb") as file:
                    told["text"] = file.read().decode(errors="surrogateescape")
    except PermissionError:
        return {"kind": "denied"}
    return told


def service_state(name: str) -> dict[str, str]:
    """Return what systemd says of a unit: "enabled" and "active", each a word of its own, or "unknown"."""
    asks = {"enabled": "is-enabled", "active": "is-active"}
    return {
        key: _output(["systemctl", ask, name], TOOL_TIMEOUT_S).strip() or "unknown"
        for key, ask in asks.items()
    }


def _is_stale(unit: str) -> bool:
    """Tell whether a unit's files were changed since systemd read them."""
    said = _output(["systemctl", "show", "-p", "NeedDaemonReload", unit], TOOL_TIMEOUT_S)
    return said.strip() == "NeedDaemonReload=yes"


def _condition(condition: Mapping[str, PlainValue]) -> bool | None:
    """Tell whether a command is done already; None when only root can say."""
    path = condition.get("creates")
    if path is None:
        return _is_done(condition["unless"], as_root=bool(condition.get("root")))
    try:
        os.lstat(os.path.expanduser(path))
    except PermissionError:
        return None
    except OSError:
        return False
    return True


def _is_done(unless: str, *, as_root: bool) -> bool:
    """Tell whether a command's condition succeeds; one that may not be asked as root does not."""
    shell = condition_command(unless)
    command = ["sudo", "-n", *shell] if as_root and os.geteuid() != 0 else shell
    status, _ = _run(command, CONDITION_TIMEOUT_S + TOOL_TIMEOUT_S, {})
    return condition_holds(unless, status)


def condition_command(unless: str) -> list[str]:
    """Return the command that asks a condition, and ends by itself; `condition_holds` reads its exit status."""
    shell = ["/bin/sh", "-c", f"exec >/dev/null 2>&1; {unless}"]
    return ["timeout", f"{CONDITION_TIMEOUT_S:g}", *shell]


def condition_holds(unless: str, status: int | None) -> bool:
    """Tell whether a condition holds, None for one that could not be asked; one that took too long is refused."""
    if status == TIMED_OUT_STATUS:
        raise HelperRefusal("timeout", f"unless: {unless}: not done in {CONDITION_TIMEOUT_S:g} s")
    return status == 0


def _start_sudo() -> subprocess.Popen[bytes] | None:
    """Ask whether this user may become root, and go on meanwhile; None for root itself."""
    if os.geteuid() == 0:
        return None
    import subprocess  # as in _run

    with contextlib.suppress(OSError):
        return subprocess.Popen(
            ["sudo", "-n", "true"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
    return None


def _end_sudo(sudo: subprocess.Popen[bytes] | None) -> dict[str, PlainValue]:
    """Tell whether this user may become root, and of one who may not what sudo says of it."""
    if sudo is None:
        is_root = os.geteuid() == 0
        return {"sudo": is_root, "sudo_refusal": None if is_root else "there is no sudo"}
    until_s = time.monotonic() + SUDO_TIMEOUT_S
    while sudo.poll() is None and time.monotonic() < until_s:
        time.sleep(SUDO_POLL_S)
    if sudo.returncode is None:
        return {"sudo": False, "sudo_refusal": f"sudo has not ended in {SUDO_TIMEOUT_S:g} s"}
    assert sudo.stderr is not None
    os.set_blocking(sudo.stderr.fileno(), False)  # who else may hold it is not waited for
    said = b""
    with contextlib.suppress(OSError):
        said = os.read(sudo.stderr.fileno(), SUDO_BYTES_MAX)
    is_refused = sudo.returncode != 0
    return {
        "sudo": not is_refused,
        "sudo_refusal": last_words(said).rpartition("\n")[2] if is_refused else None,
    }
