"""Network interfaces of a machine: how fast, how large, how healthy."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
import subprocess
from collections.abc import Sequence

from cosmos_cli.onboard.links import names_in, read_number, read_text
from cosmos_cli.onboard.request_loop import PlainValue

ERRORS = ("rx_errors", "tx_errors", "rx_crc_errors", "collisions")
DROPS = ("rx_dropped", "tx_dropped", "rx_missed_errors")
PACKETS = ("rx_packets", "tx_packets")
TOOL_TIMEOUT_S = 2.0
TOOL_FOLDERS = ("/usr/sbin", "/sbin", "/usr/bin")
SIOCGIWPOWER = 0x8B2D
"""Asks whether a Wi-Fi interface saves power (linux/wireless.h)."""


def interfaces(
    sys_: str, connected: str | None, before: Sequence[dict[str, PlainValue]] = ()
) -> list[dict[str, PlainValue]]:
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
    rows = [line.split() for line in (read_text(f"{proc}/net/snmp") or "").splitlines()]
    udp = [row for row in rows if row[:1] == ["Udp:"]]
    with contextlib.suppress(IndexError, KeyError, ValueError):
        return int(dict(zip(*udp[:2], strict=False))["RcvbufErrors"])
    return None


def _real_ones(folder: str) -> list[str]:
    """Return the interfaces that have a device behind them and are up."""
    return sorted(
        name
        for name in names_in(folder)
        if os.path.exists(f"{folder}/{name}/device")
        and read_text(f"{folder}/{name}/operstate") == "up"
    )


def _interface(path: str, before: dict[str, PlainValue] | None) -> dict[str, PlainValue]:
    name = os.path.basename(path)
    is_wireless = os.path.isdir(f"{path}/wireless") or os.path.exists(f"{path}/phy80211")
    errors = _sum(path, ERRORS)
    return {
        "name": name,
        "is_wireless": is_wireless,
        "speed_mbit": read_number(f"{path}/speed"),
        "duplex": read_text(f"{path}/duplex"),
        "mtu": read_number(f"{path}/mtu"),
        "errors": errors,
        "new_errors": errors - before["errors"] if before else 0,
        "drops": _sum(path, DROPS),
        "packets": _sum(path, PACKETS),
        "saves_power": _saves_power(name) if is_wireless else None,
    }


def _sum(path: str, names: Sequence[str]) -> int:
    return sum(read_number(f"{path}/statistics/{name}") or 0 for name in names)


def _saves_power(name: str) -> bool | None:
    """Return whether a card saves power: by its driver, or by `iw` where that does not say."""
    # struct iwreq: the name, then iw_param {s32 value; u8 fixed; u8 disabled; u16 flags}.
    request = struct.pack("16siBBH8x", name.encode()[:15], 0, 0, 0, 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked, contextlib.suppress(OSError):
        answer = fcntl.ioctl(asked, SIOCGIWPOWER, request)
        return not struct.unpack("16siBBH8x", answer)[3]
    return _saves_power_by_tool(name)


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
