"""The emulator of a Sense HAT, of which a machine has one: tests wait for each other."""

from __future__ import annotations

import contextlib
import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def emulator_held() -> Iterator[None]:
    """Be the program that drives the emulator, once no other test is."""
    from sense_emu.lock import EmulatorLock

    with (Path(tempfile.gettempdir()) / "cosmos-tests-sense-emu.lock").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        lock = EmulatorLock("sense_emu")
        lock.acquire()
        try:
            yield
        finally:
            lock.release()
