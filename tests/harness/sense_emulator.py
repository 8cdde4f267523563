"""The emulator of a Sense HAT, of which a machine has one: tests wait for each other."""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

REST = {"humidity": (40.0, 30.0), "pressure": (1013.0, 30.0)}
"""What is fed by sensor: its quantity in % and hPa, and the temperature in degC."""


@contextlib.contextmanager
def fed_emulator() -> Iterator[Any]:
    """Be the program that feeds the emulated HAT, at rest and at 30 degC, once no other test is; yield what feeds motion."""
    from sense_emu.lock import EmulatorLock

    with contextlib.ExitStack() as stack:
        turn = stack.enter_context(
            (Path(tempfile.gettempdir()) / "cosmos-tests-sense-emu.lock").open("w")
        )
        fcntl.flock(turn, fcntl.LOCK_EX)
        lock = EmulatorLock("sense_emu")
        lock.acquire()
        stack.callback(lock.release)
        for name, values in REST.items():
            module = importlib.import_module(f"sense_emu.{name}")
            server = getattr(module, f"{name.title()}Server")(simulate_noise=False)
            stack.callback(server.close)
            server.set_values(*values)
        imu = importlib.import_module("sense_emu.imu").IMUServer(simulate_world=False)
        stack.callback(imu.close)
        yield imu
