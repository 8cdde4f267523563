"""
Runs `cosmos` with machines that only pretend to be others: real processes and streams, no SSH.

    pretended_fleet.py ARGUMENT...    as `cosmos ARGUMENT...`

Every machine whose inventory entry says ssh is this computer, with a root of its own (cosmos_root). A
file <root>.fault breaks its link: "silent" swallows what is sent and says nothing, "cut" breaks the
connection. COSMOS_CONSTANTS shortens waits, as in launch_driver.py. With
COSMOS_TEST_OVER_SSH the connections are real ones, to a server of the test's own.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from cosmos_cli.fleet.connection import Completed, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection, LocalStream
from cosmos_cli.fleet.target import Target

PACKAGES = str(Path(__file__).parents[2])
LOST = "the connection was cut"


class PretendedStream(LocalStream):
    def __init__(self, command: str, connection: PretendedConnection) -> None:
        super().__init__(command)
        self._connection = connection

    def read(self, count: int, *, timeout_s: float = 0.0) -> bytes:
        if self._connection.check():
            time.sleep(timeout_s)
            raise BlockingIOError
        return super().read(count, timeout_s=timeout_s)

    def write(self, data: bytes | memoryview, *, timeout_s: float = 0.0) -> int:
        if self._connection.check():
            return len(data)
        return super().write(data, timeout_s=timeout_s)

    def close(self) -> None:
        # The other end of a link that is down does not hear of it.
        if self._connection.fault() != "silent":
            super().close()


class PretendedConnection(LocalConnection):
    opening_s = 0.0

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._is_broken = False
        if self.fault():
            raise MachineFailure(FailureKind.UNREACHABLE, "no answer")

    def fault(self) -> str:
        path = Path(f"{self.target.root}.fault")
        try:
            return path.read_text()
        except OSError:
            return ""

    def check(self) -> bool:
        fault = self.fault()
        if self._is_broken or fault == "cut":
            self._is_broken = True
            raise MachineFailure(FailureKind.LOST, LOST)
        return fault == "silent"

    def open(self, command: str) -> LocalStream:
        if self.check():
            raise MachineFailure(FailureKind.TIMEOUT, "no answer")
        return PretendedStream(command, self)

    def run(self, command: str, **how: Any) -> Completed:
        self.check()
        return super().run(command, **how)

    def is_alive(self, *, timeout_s: float = 2.0) -> bool:
        if self._is_broken or self.fault() == "cut":
            return False
        if self.fault() == "silent":
            time.sleep(timeout_s)
            return False
        return True


def connect(target: Target, options: ConnectOptions | None = None) -> LocalConnection:
    if target.connection == "local":
        return LocalConnection(target)
    return PretendedConnection(target)


def make_ready(board, target, cargo, *, machine=None, is_host=False):  # type: ignore[no-untyped-def]
    from cosmos_cli.provision.before_run import Ready

    Path(target.root).mkdir(parents=True, exist_ok=True)
    base = str(Path(cargo.scenario_path).resolve().parent)
    python = os.environ.get(f"COSMOS_TEST_PYTHON_{target.name}", sys.executable)
    return Ready(python=python, python_path=PACKAGES, base_directory=base)


def patch() -> None:
    import cosmos_cli.fleet.open_connection
    import cosmos_cli.provision.before_run
    from cosmos_cli.launch import request

    if "COSMOS_TEST_KEY_REVERSED" in os.environ:
        key = os.environ["COSMOS_TEST_KEY_REVERSED"][::-1]
        token = request.secrets.token_hex
        request.secrets.token_hex = lambda count: key if count == 32 else token(count)
    if "COSMOS_TEST_OVER_SSH" not in os.environ:
        cosmos_cli.fleet.open_connection.connect = connect  # type: ignore[assignment]
    cosmos_cli.provision.before_run.make_ready = make_ready
    for dotted, value in json.loads(os.environ.get("COSMOS_CONSTANTS", "{}")).items():
        module, name = dotted.split(".")
        target = importlib.import_module(f"cosmos_cli.launch.{module}")
        assert hasattr(target, name), dotted
        setattr(target, name, value)


if __name__ == "__main__":
    patch()
    from cosmos_cli.app import main

    main(sys.argv[1:])
