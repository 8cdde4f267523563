"""Network interfaces of a machine: how fast, how large, how healthy."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Sequence
from typing import Any

ERRORS = ("rx_errors", "tx_errors", "rx_crc_errors", "collisions")
DROPS = ("rx_dropped", "tx_dropped", "rx_missed_errors")
PACKETS = ("rx_packets", "tx_packets")
TOOL_TIMEOUT_S = 2.0
TOOL_FOLDERS = ("/usr/sbin", "/sbin", "/usr/bin")
SIOCGIWPOWER = 0x8B2D
"""Asks whether a Wi-Fi interface saves power (linux/wireless.h)."""


def interfaces(
    sys_: str, connected: str | None, before: Sequence[dict[str, Any]] = ()
) -> list[dict[str, Any]]:
    """
    Tell of the interface of the connection, or, where nobody knows which that is, of all real ones.

    Args:
        sys_: Where /sys is.
        connected: Name of the connection's interface.
        before: An earlier answer: errors since then are told as well.
    """
    folder = f"{sys_}/class/net"
    names = [connected] if connected else _real_ones(folder)
    earlier = {item["name"]: item for item in before}
    return [_interface(f"{folder}/{name}", earlier.get(name)) for name in names]


def receive_drops(proc: str) -> int | None:
    """Return how many datagrams were dropped because a program's receive buffer was full, since boot."""
    keys: list[str] = []
    with contextlib.suppress(OSError, ValueError), open(f"{proc}/net/snmp") as file:
        for line in file:
            if line.startswith("Udp:"):
                if keys:
                    return int(line.split()[keys.index("RcvbufErrors")])
                keys = line.split()
    return None


def _real_ones(folder: str) -> list[str]:
    """Return the interfaces that have a device behind them and are up."""
    with contextlib.suppress(OSError):
        return sorted(
            name
            for name in os.listdir(folder)
            if os.path.exists(f"{folder}/{name}/device")
            and _text(f"{folder}/{name}/operstate") == "up"
        )
    return []


def _interface(path: str, before: dict[str, Any] | None) -> dict[str, Any]:
    name = os.path.basename(path)
    is_wireless = os.path.isdir(f"{path}/wireless") or os.path.exists(f"{path}/phy80211")
    told: dict[str, Any] = {
        "name": name,
        "is_wireless": is_wireless,
        "speed_mbit": _number(f"{path}/speed"),
        "duplex": _text(f"{path}/duplex"),
        "mtu": _number(f"{path}/mtu"),
        "errors": _sum(path, ERRORS),
        "drops": _sum(path, DROPS),
        "packets": _sum(path, PACKETS),
        "saves_power": _saves_power(name) if is_wireless else None,
    }
    told["new_errors"] = told["errors"] - before["errors"] if before else 0
    return told


def _sum(path: str, names: Sequence[str]) -> int:
    return sum(_number(f"{path}/statistics/{name}") or 0 for name in names)


def _text(path: str) -> str | None:
    try:
        with open(path) as file:
            return file.read(4096).strip()
    except (OSError, ValueError):  # an interface that is down tells no speed
        return None


def _number(path: str) -> int | None:
    with contextlib.suppress(TypeError, ValueError):
        return int(_text(path))  # type: ignore[arg-type]
    return None


def _saves_power(name: str) -> bool | None:
    found = _saves_power_by_ioctl(name)
    return _saves_power_by_tool(name) if found is None else found


def _saves_power_by_ioctl(name: str) -> bool | None:
    import fcntl
    import socket
    import struct

    # struct iwreq: the name, then iw_param {s32 value; u8 fixed; u8 disabled; u16 flags}.
    request = struct.pack("16siBBH8x", name.encode()[:15], 0, 0, 0, 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked, contextlib.suppress(OSError):
        answer = fcntl.ioctl(asked, SIOCGIWPOWER, request)
        return not struct.unpack("16siBBH8x", answer)[3]
    return None


def _saves_power_by_tool(name: str) -> bool | None:
    tool = next(
        (f"{folder}/iw" for folder in TOOL_FOLDERS if os.access(f"{folder}/iw", os.X_OK)), None
    )
    if tool is None:
        return None
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            [tool, "dev", name, "get", "power_save"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=TOOL_TIMEOUT_S,
            check=False,
        )
        words = done.stdout.decode(errors="replace").split()
        return words[-1] == "on" if words[-1:] in (["on"], ["off"]) else None
    return None
