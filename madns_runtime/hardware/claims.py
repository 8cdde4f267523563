"""
Claims on a machine's devices: two runs that open the same one would spoil each other's reads and outputs.

A claim is a lock on files in the machine's state folder: one of the device, and one of each part of the machine that its
kind needs for itself alone, so that the same chip is refused under another name as well. The processes that drive the
device and make it safe keep the descriptors, so that it lasts until the last one that has the device open is gone,
however it ended.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import DeviceKind
from madns_runtime.plugin.context import clean_text
from madns_runtime.processes import state_directory

WAIT_S: Final = 4.0
"""Time for the processes of an earlier supervisor of the same machine to make safe, close and end."""
POLL_S: Final = 0.05
HOLDER_BYTES_MAX: Final = 4096
FOLDER: Final = "devices"


class DeviceClaims:
    """
    Claims of one supervisor.

    Args:
        run: Its run's name, told to whoever is refused.
    """

    def __init__(self, run: str) -> None:
        self._run = run
        self._descriptors: dict[Path, int] = {}
        self.problem = ""
        """Why claims cannot be kept here, which is no reason to fail; empty where they can."""

    def claim(
        self, device: DeviceLaunch, kind: DeviceKind, exclusive: Sequence[str] = ()
    ) -> frozenset[int]:
        """
        Claim a device of the machine; one of a kind that needs no hardware is open to all.

        Args:
            device: By its name.
            kind: Of it.
            exclusive: Parts of the machine, see `Needs`; several devices of this run may have the same.

        Returns:
            Its descriptors: a forked process that opens the device keeps them, else its claim ends before it does.

        Raises:
            MachineError: Another run has it.
        """
        if not kind.needs_hardware:
            return frozenset()
        held: set[int] = set()
        for path, part in [
            (claim_path(device), ""),
            *((_path_of(["part", part]), part) for part in sorted(exclusive)),
        ]:
            if path not in self._descriptors:
                try:
                    descriptor = _open(path)
                except OSError as error:
                    self.problem = (
                        f"other runs are not kept from its devices: {error.strerror or error}"
                    )
                    break
                self._lock(descriptor, device.full_name, part)
                self._descriptors[path] = descriptor
            held.add(self._descriptors[path])
        return frozenset(held)

    def _lock(self, descriptor: int, device: str, part: str) -> None:
        """
        Lock a file, and note in it who has what.

        Raises:
            MachineError: Another run has it.
        """
        deadline_s = monotonic() + WAIT_S
        while not _is_locked_now(descriptor):
            if monotonic() > deadline_s:
                holder = _holder(descriptor, device)
                os.close(descriptor)
                what = f"device {device}: {part}" if part else f"device {device}"
                raise MachineError(
                    f"{what} is in use by {holder}: end it (cosmos ps, cosmos down) or wait for its end"
                )
            sleep(POLL_S)
        told = json.dumps({"run": self._run, "pid": os.getpid(), "device": device}).encode()
        with contextlib.suppress(OSError):  # a full disk: the claim holds all the same
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, told, 0)

    def tell_problem(self, emit: Callable[[Mapping[str, Any]], None]) -> None:
        """Tell the operator, by an event, if claims cannot be kept here."""
        if self.problem:
            emit({"event": "log", "level": "warning", "text": self.problem})

    def release(self) -> None:
        """Give up what this process claims, whatever others still hold; harmless when repeated."""
        for descriptor in self._descriptors.values():
            os.close(descriptor)
        self._descriptors = {}


def claim_path(device: DeviceLaunch) -> Path:
    """Return the file that is locked for a device: of one name, kind, serial and parameters."""
    return _path_of([device.full_name, device.kind, device.serial, dict(device.parameters)])


def _path_of(key: Sequence[Any]) -> Path:
    digest = hashlib.sha256(json.dumps(key, sort_keys=True, default=str).encode()).hexdigest()
    return state_directory().parent / FOLDER / f"{digest[:32]}.lock"


def _open(path: Path) -> int:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)


def _is_locked_now(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _holder(descriptor: int, device: str) -> str:
    """Return who has a claim, as far as it is told, and as which device if it is another than *device*."""
    try:
        told = json.loads(os.pread(descriptor, HOLDER_BYTES_MAX, 0))
        other = clean_text(str(told.get("device", device)))[:200]
        suffix = "" if other == device else f" as {other}"
        return f"run {clean_text(str(told['run']))[:200]} (pid {int(told['pid'])}){suffix}"
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return "another run"
