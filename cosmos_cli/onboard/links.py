"""Network link of a machine to the operator, from what its kernel shows; nothing is changed."""

from __future__ import annotations

import _socket
import contextlib
import fcntl
import os

from cosmos_cli.onboard.request_loop import PlainValue

TEXT_BYTES_MAX = 262_144


def network(proc: str, sys_: str) -> dict[str, PlainValue]:
    """Tell of the receive buffer, of the interface by which the operator came, and of Wi-Fi."""
    wireless = {
        name for name in names_in(f"{sys_}/class/net") if _is_wireless(f"{sys_}/class/net/{name}")
    }
    interface = _interface_of_connection(proc)
    up = [name for name in wireless if read_text(f"{sys_}/class/net/{name}/operstate") == "up"]
    return {
        "receive_buffer_bytes_max": read_number(f"{proc}/sys/net/core/rmem_max"),
        "interface": interface,
        "is_wireless": interface in wireless if interface else None,
        "wireless_up": sorted(up),
    }


def _is_wireless(interface: str) -> bool:
    """Tell of an interface, or of a bridge by its members."""
    if os.path.isdir(f"{interface}/wireless") or os.path.exists(f"{interface}/phy80211"):
        return True
    folder = os.path.dirname(interface)
    return any(_is_wireless(f"{folder}/{member}") for member in names_in(f"{interface}/brif"))


def _interface_of_connection(proc: str) -> str | None:
    """Return the interface that has the address by which the operator came; None when nobody knows."""
    words = os.environ.get("SSH_CONNECTION", "").split()
    if len(words) != 4:
        return None
    own = words[2].partition("%")[0]
    return _interface_v6(own, proc) if ":" in own else _interface_v4(own)


def _interface_v4(own: str) -> str | None:
    get_address = 0x8915  # SIOCGIFADDR
    with contextlib.closing(_socket.socket(_socket.AF_INET, _socket.SOCK_DGRAM)) as asked:
        for _, name in _socket.if_nameindex():
            with contextlib.suppress(OSError):
                wanted = name.encode()[:15].ljust(256, b"\0")
                found = fcntl.ioctl(asked.fileno(), get_address, wanted)
                if _socket.inet_ntoa(found[20:24]) == own:
                    return name
    return None


def _interface_v6(own: str, proc: str) -> str | None:
    wanted = _socket.inet_pton(_socket.AF_INET6, own).hex()
    for line in (read_text(f"{proc}/net/if_inet6") or "").splitlines():
        words = line.split()
        if words[0] == wanted:
            return words[-1]
    return None


def read_text(path: str) -> str | None:
    """Return what a file of the kernel says, without its end; None where there is none."""
    try:
        with open(path, "rb") as file:
            return file.read(TEXT_BYTES_MAX).rstrip(b"\0\n ").decode(errors="replace")
    except OSError:
        return None


def read_number(path: str, base: int = 10) -> int | None:
    """Return the number in a file of the kernel; None where there is none."""
    with contextlib.suppress(ValueError):
        return int(read_text(path) or "", base)
    return None


def kilobyte_sizes(path: str) -> dict[str, int]:
    """Return the sizes that a file such as /proc/meminfo names in kB, by name, B."""
    rows = (line.partition(":") for line in (read_text(path) or "").splitlines())
    return {key: int(value[:-3]) * 1024 for key, _, value in rows if value.endswith(" kB")}


def names_in(folder: str) -> list[str]:
    """Return the names in a folder; none where there is no folder."""
    with contextlib.suppress(OSError):
        return os.listdir(folder)
    return []
