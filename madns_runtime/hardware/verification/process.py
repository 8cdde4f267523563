"""A device as a run has it: for itself alone, in a process that is killed, hung, ended."""

from __future__ import annotations

import mmap
import os
import signal
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from time import monotonic, sleep
from typing import Any, Final

from madns_runtime.config import AgentLaunch, Agents, DeviceLaunch, RunConfig
from madns_runtime.hardware import page
from madns_runtime.hardware.claims import DeviceClaims
from madns_runtime.hardware.contract import Device
from madns_runtime.hardware.kind_registry import DeviceProgram
from madns_runtime.hardware.manager import DeviceManager
from madns_runtime.hardware.verification.order import (
    PORT,
    SAFE_S_MAX,
    Findings,
    VerificationFinding,
    VerificationOrder,
    finding,
    has_stand_in,
)
from madns_runtime.reactor.reactor import Reactor

RETURN_S_MAX: Final = 2.0
HEALTH_S: Final = 1.0
"""Until a device that gives nothing is asked anything, which is its health."""
BLOCKED_S: Final = 600.0
HANG_S: Final = 1.0
RUN, PLACE, NAME, OWNER = "0001-verify", "here", "device", "agent-01"


def claimed(
    order: VerificationOrder, program: DeviceProgram, run: Callable[[], Findings]
) -> Findings:
    """
    Return the findings of a step that drives a device itself, for whose length no run has it; in a process of its own.

    Raises:
        MachineError: A run has it, or a part of the machine that it needs for itself alone.
    """
    claims = DeviceClaims(RUN)  # they end with the process, whatever the driver has started
    claims.claim(_launch_of(order, program, 1.0, False), program.kind, program.needs.exclusive)
    return run()


def lose_device(
    order: VerificationOrder, program: DeviceProgram, rate_hz: float, may_write: bool
) -> Findings:
    """Kill, stop and block the device's process as a run drives it, and look how it comes back."""
    with tempfile.TemporaryDirectory(prefix="cosmos-verify-") as folder:
        config = RunConfig(
            run=RUN, scenario="verify", simulation="verify",
            base_directory=order.directory, agents=Agents(count=1),
        )  # fmt: skip
        device = _launch_of(order, program, rate_hz, may_write)
        launch = AgentLaunch(
            config=config, run_key_hex="0" * 64, session_hex="0" * 16, machine=PLACE,
            agents=(OWNER,), host_address="", host_port=0, directory=folder, devices=(device,),
        )  # fmt: skip
        return _DrivenDevice(launch, may_write, 10.0 / rate_hz).run()


def _launch_of(
    order: VerificationOrder, program: DeviceProgram, rate_hz: float, may_write: bool
) -> DeviceLaunch:
    parameters = dict(order.parameters)
    if has_stand_in(order):
        parameters[PORT] = program.parameters.port
    return DeviceLaunch(
        name=NAME, place=PLACE, kind=order.kind, base_directory=order.directory,
        rate_hz=rate_hz, parameters=parameters, users=(OWNER,), owner=OWNER,
        may_move=may_write, hang_s=HANG_S,
    )  # fmt: skip


class _DrivenDevice:
    """One device under the manager of a run; arguments as told in `lose_device`."""

    def __init__(self, launch: AgentLaunch, may_write: bool, slow_s: float) -> None:
        self._manager = DeviceManager(launch, tell=lambda doing: None)
        self._hang = mmap.mmap(-1, mmap.PAGESIZE)
        self._manager.alter(f"{PLACE}/{NAME}", partial(_hang_once, self._hang))
        self._header = self._manager.page_of(f"{PLACE}/{NAME}").header
        self._has_outputs = may_write and self._manager.is_guarded(f"{PLACE}/{NAME}")
        self._hang_s = max(HANG_S, slow_s)
        self._reactor = Reactor()

    def run(self) -> Findings:
        """Lose the device in each way, and return what was seen."""
        header, manager, reactor = self._header, self._manager, self._reactor
        manager.start()
        events: list[Mapping[str, Any]] = []
        manager.watch(reactor, events.append)
        reactor.on_signal(signal.SIGCHLD, manager.reap)
        manager.reap()  # who has ended before that was listened to
        if self._until(lambda: header[page.STATE] == page.OPEN, 20.0) is None:
            manager.close()
            whys = [str(event["why"]) for event in events if event.get("why")]
            why = f": {whys[-1]}" if whys else ""
            return [
                finding(
                    "process", False, f"it was not open within 20 s{why}", "opened by its process"
                )
            ]
        findings = self._lost_by(self._signal(signal.SIGKILL), "kill -9", RETURN_S_MAX)
        hang_s = self._hang_s + RETURN_S_MAX
        findings += self._lost_by(self._signal(signal.SIGSTOP), "hang", hang_s)
        findings += self._lost_by(self._block, "hang in a call", hang_s + HEALTH_S)
        began_s = monotonic()
        count = header[page.SAFE_COUNT]
        manager.close()
        ended_s = monotonic() - began_s
        findings.append(
            finding("its end", ended_s <= RETURN_S_MAX, f"{ended_s:.2f} s", f"{RETURN_S_MAX:g} s")
        )
        is_safe = header[page.SAFE_COUNT] > count and header[page.STATE] == page.SAFE
        findings.append(self._safe("safe at its end", ended_s if is_safe else None, RETURN_S_MAX))
        reactor.close()
        return findings

    def _signal(self, number: signal.Signals) -> Callable[[], None]:
        return lambda: os.kill(int(self._header[page.PID]), number)

    def _block(self) -> None:
        """Let the driver's next call block where no signal of Python's reaches it."""
        self._hang[0] = 1

    def _lost_by(self, lose: Callable[[], None], how: str, limit_s: float) -> Findings:
        header = self._header
        pid, count = int(header[page.PID]), header[page.SAFE_COUNT]
        if self._has_outputs:
            header[page.MOVED] = (
                1.0  # else the next process leaves it, if it is there before the guardian hears
            )
        lose()
        safe_s: float | None = 0.0
        extra_s = limit_s - RETURN_S_MAX
        if self._has_outputs:
            safe_s = self._until(lambda: header[page.SAFE_COUNT] > count, extra_s + 10.0)
        spent_s = safe_s or 0.0
        back_s = self._until(
            lambda: int(header[page.PID]) != pid and header[page.STATE] == page.OPEN, 20.0
        )
        is_back = back_s is not None and spent_s + back_s <= limit_s
        got = "never" if back_s is None else f"open again after {spent_s + back_s:.2f} s"
        return [
            finding(how, is_back, got, f"{limit_s:g} s"),
            self._safe(f"safe after {how}", safe_s, extra_s + SAFE_S_MAX),
        ]

    def _safe(self, name: str, safe_s: float | None, limit_s: float) -> VerificationFinding:
        if not self._has_outputs:
            return finding(name, None, "no output may move")
        got = "not made safe" if safe_s is None else f"{safe_s:.2f} s"
        return finding(name, safe_s is not None and safe_s <= limit_s, got, f"{limit_s:g} s")

    def _until(self, is_so: Callable[[], bool], timeout_s: float) -> float | None:
        """Run the loop until something is so; return how long that took, s, or None if it never was."""
        began_s = monotonic()

        def look() -> None:
            if is_so() or monotonic() > began_s + timeout_s:
                self._reactor.stop()
            else:
                self._reactor.call_at(monotonic() + 0.005, look)

        self._reactor.call_at(0.0, look)
        self._reactor.run()
        return monotonic() - began_s if is_so() else None


def _hang_once(hang: mmap.mmap, device: Device) -> None:
    """Let a device's calls that read block for ever, once after *hang* was set."""

    def blocking(call: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any) -> Any:
            if hang[0]:
                hang[0] = 0
                sleep(BLOCKED_S)
            return call(*arguments)

        return called

    for name in ("read", "sample_at", "health"):
        if hasattr(device, name):
            setattr(device, name, blocking(getattr(device, name)))
