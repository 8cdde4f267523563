"""
The system calls that a tower is made of and that Python's `os` does not offer.

Every function here is one call, or one file that is one call; whatever fails raises OSError with the
name of the call, because "[Errno 1] Operation not permitted" alone tells nobody anything.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import signal
import struct
from collections.abc import Iterable
from pathlib import Path

CLONE_NEWTIME = 0x00000080
CLONE_NEWNS = 0x00020000
CLONE_NEWCGROUP = 0x02000000
CLONE_NEWUTS = 0x04000000
CLONE_NEWIPC = 0x08000000
CLONE_NEWPID = 0x20000000
CLONE_NEWNET = 0x40000000

MS_RDONLY = 0x1
MS_NOSUID = 0x2
MS_NODEV = 0x4
MS_NOEXEC = 0x8
MS_REMOUNT = 0x20
MS_NOATIME = 0x400
MS_BIND = 0x1000
MS_REC = 0x4000
MS_PRIVATE = 1 << 18
MNT_DETACH = 2

PR_SET_PDEATHSIG = 1
PR_CAPBSET_DROP = 24
SYS_PIVOT_ROOT = {"x86_64": 155, "aarch64": 41, "armv7l": 218}

EXT4_IOC_SHUTDOWN = 0x8004587D
EXT4_SHUTDOWN_NOLOGFLUSH = 2
FITRIM = 0xC0185879
LOOP_CTL_REMOVE = 0x4C81

SIOCSIFFLAGS = 0x8914
SIOCSIFADDR = 0x8916
SIOCSIFNETMASK = 0x891C
IFF_UP = 0x1

_libc = ctypes.CDLL(None, use_errno=True)


def _check(result: int, call: str) -> None:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{call}: {os.strerror(number)}")


def unshare(flags: int) -> None:
    """Leave the namespaces in *flags* for new ones."""
    _check(_libc.unshare(flags), f"unshare({flags:#x})")


def enter(path: str, kind: int = 0) -> None:
    """Join the namespace behind *path*, such as /proc/123/ns/net."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        _check(_libc.setns(descriptor, kind), f"setns({path})")
    finally:
        os.close(descriptor)


def mount(
    source: str | Path | None, target: str | Path, kind: str = "", flags: int = 0, data: str = ""
) -> None:
    """Call mount(2)."""
    arguments = [None if source is None else os.fsencode(source), os.fsencode(target)]
    result = _libc.mount(*arguments, kind.encode() or None, flags, data.encode() or None)
    _check(result, f"mount {kind or 'flags'} {source} on {target} ({data})")


def unmount(target: str | Path, flags: int = 0) -> None:
    """Call umount2(2)."""
    _check(_libc.umount2(os.fsencode(target), flags), f"umount {target}")


def make_mounts_private() -> None:
    """Keep what this process mounts from now on to its own mount namespace."""
    mount(None, "/", flags=MS_REC | MS_PRIVATE)


def change_root(root: str | Path) -> None:
    """Make *root* the root directory and drop the old one with everything mounted in it."""
    os.chdir(root)
    number = SYS_PIVOT_ROOT[os.uname().machine]
    _check(_libc.syscall(number, b".", b"."), f"pivot_root({root})")
    unmount(".", MNT_DETACH)
    os.chdir("/")


def die_with_parent(parent: int) -> None:
    """Be killed when *parent*, which must be the parent process, ends."""
    _check(_libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:  # it ended before the call
        os._exit(1)


def drop_capabilities(numbers: Iterable[int]) -> None:
    """Take capabilities from this process's bounding set: no program it starts can have them."""
    for number in numbers:
        _libc.prctl(PR_CAPBSET_DROP, number, 0, 0, 0)  # EINVAL: the kernel does not know it


def set_host_name(name: str) -> None:
    """Name the machine in this UTS namespace."""
    _check(_libc.sethostname(name.encode(), len(name.encode())), "sethostname")


def lose_power(disk: Path) -> None:
    """End an ext4 file system as a power cut does: nothing that was not synced reaches the medium."""
    descriptor = os.open(disk, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.ioctl(descriptor, EXT4_IOC_SHUTDOWN, struct.pack("I", EXT4_SHUTDOWN_NOLOGFLUSH))
    finally:
        os.close(descriptor)


def sync(disk: Path) -> None:
    """Write what this file system has not written yet, and leave other boards' to themselves, as `sync` would not."""
    descriptor = os.open(disk, os.O_RDONLY | os.O_CLOEXEC)
    try:
        _check(_libc.syncfs(descriptor), "syncfs")
    finally:
        os.close(descriptor)


def trim(disk: Path) -> None:
    """Give back what a file system's deleted files take on its medium."""
    descriptor = os.open(disk, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.ioctl(descriptor, FITRIM, struct.pack("QQQ", 0, 2**64 - 1, 0))
    finally:
        os.close(descriptor)


def remove_loop_device(number: int) -> bool:
    """Take an unused loop device back out of the kernel; False if it is in use."""
    try:
        with open("/dev/loop-control", "rb") as control:
            fcntl.ioctl(control, LOOP_CTL_REMOVE, number)
    except OSError as error:
        return error.errno == errno.ENODEV  # it is gone already
    return True


def raise_interface(name: str, address: str | None = None, prefix_bits: int = 16) -> None:
    """Give an interface of this network namespace an IPv4 address and switch it on."""
    import socket  # only boards' set-up needs it

    mask = (0xFFFFFFFF << (32 - prefix_bits)) & 0xFFFFFFFF
    requests = []
    if address is not None:
        requests.append((SIOCSIFADDR, _address_request(name, socket.inet_aton(address))))
        requests.append((SIOCSIFNETMASK, _address_request(name, struct.pack("!I", mask))))
    requests.append((SIOCSIFFLAGS, struct.pack("16sH22x", name.encode(), IFF_UP)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        for number, request in requests:
            fcntl.ioctl(endpoint, number, request)


def _address_request(name: str, address: bytes) -> bytes:
    return struct.pack("16sHH4s16x", name.encode(), 2, 0, address)
