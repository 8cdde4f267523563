"""
Removes what a tower's supervisor can leave behind when it is killed: control groups and files.

Boards, mounts, network interfaces and loop devices end with their processes. A guardian process does
this as soon as its supervisor ends; `down` does it when the guardian was killed as well.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

from . import kernel
from .board import kill_group, remove_group
from .disk import list_loop_devices, remove_loop_devices
from .network import remove_interface
from .places import Places

GROUPS = "groups"
LOOP_PATIENCE_S = 2.0
KILLED_LOOP_PATIENCE_S = 15.0
"""A killed board lets its disk go a moment after its end, on a busy machine later; another tower's disk stays in use."""


def mount_groups(places: Places) -> Path:
    """
    Make the tower's control group and mount it where only this mount namespace sees it.

    Only the tower's own: nothing that goes wrong here may reach the machine's other groups.
    """
    target = places.folder / GROUPS
    target.mkdir(exist_ok=True)
    kernel.mount("cgroup2", target, "cgroup2")
    own = target / places.cgroup
    own.mkdir(exist_ok=True)
    kernel.mount(own, target, flags=kernel.MS_BIND)
    return target


def unmount(places: Places) -> None:
    """Take away the mounts of this mount namespace in the tower's folder."""
    for path in (places.private, places.folder / GROUPS):
        while os.path.ismount(path):
            kernel.unmount(path, kernel.MNT_DETACH)


def clean(places: Places, loop_patience_s: float = LOOP_PATIENCE_S) -> None:
    """Remove every trace of a tower. The caller owns its index."""
    _in_child(lambda: _clean_groups(places))
    if Path(f"/sys/class/net/{places.uplink}").exists():
        remove_interface(places.uplink)
    with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
        before = json.loads(places.loops.read_text())
        remove_loop_devices(list_loop_devices() - set(before), loop_patience_s)
    places.remove()


def start_guardian(places: Places, lock: int) -> int:
    """
    Fork the process that cleans up when this one has ended.

    Args:
        places: The tower's.
        lock: The descriptor that owns its index; the guardian owns it, too, until it is done.

    Returns:
        A descriptor; the guardian wakes up when its last copy is closed.
    """
    read, write = os.pipe2(os.O_CLOEXEC)
    child = os.fork()
    if child:
        os.close(read)
        os.waitpid(child, 0)
        return write
    try:
        if os.fork():  # nobody's child: its end concerns nobody
            os._exit(0)
        os.setsid()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        os.chdir("/")
        null = os.open("/dev/null", os.O_RDWR)
        for descriptor in range(3):
            os.dup2(null, descriptor)
        os.close(write)
        os.read(read, 1)
        with contextlib.suppress(FileNotFoundError):  # cleaned by the supervisor itself
            if os.path.samestat(os.fstat(lock), places.folder.stat()):
                clean(places, KILLED_LOOP_PATIENCE_S)
    finally:
        os._exit(0)


def _clean_groups(places: Places) -> None:
    """Kill what is left in the tower's control groups and remove them."""
    kernel.unshare(kernel.CLONE_NEWNS)
    kernel.make_mounts_private()
    groups = mount_groups(places)
    for group in [path for path in groups.iterdir() if path.is_dir()]:
        kill_group(group)
        remove_group(group)
    kernel.unmount(groups)
    remove_group(groups / places.cgroup)


def _in_child(function: Callable[[], None]) -> None:
    """Call *function* in a process of its own: its mounts end with it."""
    child = os.fork()
    if child == 0:
        try:
            function()
        finally:
            os._exit(0)
    os.waitpid(child, 0)  # each of its waits has a deadline
