"""A device manager in a loop of the test's own, with a driver on a pseudo-terminal that tells what it is asked."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from madns_runtime.config import AgentLaunch, Agents, DeviceLaunch, RunConfig
from madns_runtime.hardware.manager import DeviceManager
from madns_runtime.hardware.port import Hardware
from madns_runtime.reactor.reactor import Reactor

AGENT = "agent-01"
PATIENCE_S = 120.0
"""A busy machine is slow; what takes this long hangs."""
SILENCE_S = 60.0
"""Without a sample for so long a device of these tests is lost, unless silence is what a test is about: a busy machine
keeps a process waiting for longer than the second of a run."""
DRIVER = """
import os, signal, time, tty
from dataclasses import dataclass

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample


@dataclass(frozen=True, kw_only=True)
class Parameters:
    port: str
    read_s: float = 0.0
    hang_file: str = ""
    gone_file: str = ""
    close_s: float = 0.0
    raises: str = ""
    takes_no: float = 2.0


class Line(Device):
    kind = DeviceKind(
        name="line",
        summary="a pseudo-terminal",
        parameters=Parameters,
        channels=(
            Channel(name="time", unit="s"),
            Channel(name="valve", direction="out", limits=(0.0, 1.0), safe=0.0),
        ),
    )

    def open(self):
        self._raise("open")
        self.fd = os.open(self.parameters.port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)
        self.say("OPEN")
        return "line-1"

    def read(self):
        self._raise("read")
        taken_s = time.monotonic()
        if self.parameters.read_s:
            time.sleep(self.parameters.read_s)
        while self.parameters.hang_file and os.path.exists(self.parameters.hang_file):
            time.sleep(0.05)
        if self.parameters.gone_file and os.path.exists(self.parameters.gone_file):
            raise OSError("the line is gone")
        return Sample(values={"time": taken_s}, taken_s=taken_s)

    def write(self, values, due_s):
        self._raise("write")
        if values["valve"] == self.parameters.takes_no:
            raise PluginError(f"expected none of {values['valve']:g}")
        self.say(f"VALVE {values['valve']:g}")

    def health(self):
        self._raise("health")
        return {"well": True}

    def make_safe(self):
        self.say("SAFE")
        self._raise("make_safe")
        if self.parameters.raises == "alarm":
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.raise_signal(signal.SIGALRM)
        if self.parameters.raises == "nothing":
            time.sleep(600)

    def close(self):
        time.sleep(self.parameters.close_s)
        if hasattr(self, "fd"):
            os.close(self.fd)
        self._raise("close")

    def say(self, text):
        os.write(self.fd, f"{text}\\n".encode())

    def _raise(self, method):
        if self.parameters.raises == method:
            raise ValueError(f"{method} does not work")
"""


MEASURED = re.compile(r"(open again after )?\d+\.\d+ (s|Hz)")


def is_late(finding: Mapping[str, Any]) -> bool:
    """Tell whether a finding of `verification` is a time that was measured and is too long, as on a busy machine."""
    return finding["passed"] is False and MEASURED.fullmatch(finding["got"]) is not None


class DeviceBench:
    """
    One machine's devices, and the agent that uses them.

    Args:
        folder: A folder of the test's own.
        devices: What the machine drives.
        lost_s: Without a sample for how long a device is lost, s; None as in a run.
    """

    def __init__(
        self, folder: Path, devices: tuple[DeviceLaunch, ...], *, lost_s: float | None = SILENCE_S
    ) -> None:
        config = RunConfig(
            run="0001-devices",
            scenario="devices",
            simulation="counter",
            base_directory=str(folder),
            agents=Agents(count=1),
        )
        launch = AgentLaunch(
            config=config,
            run_key_hex="0" * 64,
            session_hex="0" * 16,
            machine="here",
            agents=(AGENT,),
            host_address="",
            host_port=0,
            directory=str(folder),
            devices=devices,
        )
        self.folder = folder
        self.events: list[Mapping[str, Any]] = []
        self.manager = DeviceManager(launch, tell=lambda doing: None)
        for driven in self.manager._devices.values() if lost_s is not None else ():
            driven.limits = replace(driven.limits, lost_s=lost_s)
        self.manager.start()
        self.reactor = Reactor()
        self.manager.watch(self.reactor, self.events.append)
        self.reactor.on_signal(signal.SIGCHLD, self.manager.reap)
        self.manager.reap()
        self.hardware: Hardware = self.manager.hardware_of(AGENT)

    def until(self, is_so: Callable[[], bool], timeout_s: float = PATIENCE_S) -> float:
        """Run the loop until something is so, and return how long that took, s."""
        began_s = time.monotonic()

        def look() -> None:
            if is_so() or time.monotonic() > began_s + timeout_s:
                self.reactor.stop()
            else:
                self.reactor.call_at(time.monotonic() + 0.005, look)

        self.reactor.call_at(0.0, look)
        self.reactor.run()
        assert is_so(), f"not so within {timeout_s:g} s; told so far: {self.events}"
        return time.monotonic() - began_s

    def run(self, seconds: float) -> None:
        """Run the loop for a while."""
        self.reactor.call_at(time.monotonic() + seconds, self.reactor.stop)
        self.reactor.run()

    def start_time(self) -> float:
        """Let simulated time run, and return when it began, s."""
        zero_s = time.monotonic()
        self.hardware.tell_time(zero_s, 0.0, 1.0)
        return zero_s

    def statuses(self, name: str) -> list[str]:
        """
        Return the statuses of a device that the operator was told, in order.

        Stale counts as ok: a machine that does other work makes samples wait.
        """
        told = [
            "ok" if event["status"] == "stale" else event["status"]
            for event in self.events
            if event["event"] == "device" and event["device"].endswith(f"/{name}")
        ]
        return [status for status, _ in itertools.groupby(told)]

    def pid_of(self, index: int = 0) -> int:
        """Return the process of a device."""
        return self.manager._processes[index].pid

    def close(self) -> Mapping[str, Any]:
        """End the devices, and return what became of them."""
        result = self.manager.close()
        self.reactor.close()
        return result


class Terminal:
    """A pseudo-terminal: the driver has one end, the test the other."""

    def __init__(self) -> None:
        self.fd, self._other = os.openpty()
        tty.setraw(self._other)
        os.set_blocking(self.fd, False)
        self.port = os.ttyname(self._other)
        self._heard = b""

    def heard(self) -> list[str]:
        """Return all lines that the driver has said so far."""
        with contextlib.suppress(BlockingIOError, OSError):
            while data := os.read(self.fd, 65_536):
                self._heard += data
        return self._heard.decode().splitlines()

    def close(self) -> None:
        """Unplug it."""
        for fd in (self.fd, self._other):
            with contextlib.suppress(OSError):
                os.close(fd)


@contextlib.contextmanager
def line_bench(
    folder: Path,
    *,
    rate_hz: float = 50.0,
    launch: Mapping[str, Any] | None = None,
    lost_s: float | None = SILENCE_S,
    **parameters: Any,
) -> Iterator[tuple[DeviceBench, Terminal]]:
    """Run a bench with the driver above on a pseudo-terminal, as pi22/line."""
    terminal = Terminal()
    (folder / "line.py").write_text(DRIVER, encoding="utf-8")
    device = DeviceLaunch(
        name="line",
        place="pi22",
        kind="./line.py:Line",
        base_directory=str(folder),
        rate_hz=rate_hz,
        parameters={"port": terminal.port, **parameters},
        users=(AGENT,),
        owner=AGENT,
        **{"may_move": True, **(launch or {})},
    )
    bench = DeviceBench(folder, (device,), lost_s=lost_s)
    try:
        yield bench, terminal
    finally:
        with contextlib.suppress(Exception):
            bench.close()
        terminal.close()


def still_running(folder: Path) -> list[int]:
    """Return the processes that have a file of the folder open."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            links = [os.readlink(fd) for fd in (path / "fd").iterdir()]
            if int(path.name) != os.getpid() and any(str(folder) in link for link in links):
                found.append(int(path.name))
    return found
