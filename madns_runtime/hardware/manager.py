"""
A machine's devices in a run: their processes are started, watched, given up, started anew, and ended.

It lives in the supervisor of the machine's agents. Everything that agents and devices share is made in its
constructor, before anybody is forked.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

from madns_runtime.config import AgentLaunch
from madns_runtime.errors import MachineError
from madns_runtime.hardware import guardian, messages, page
from madns_runtime.hardware.child_process import fork_with_pair, kill, wait_for
from madns_runtime.hardware.claims import DeviceClaims
from madns_runtime.hardware.contract import Device
from madns_runtime.hardware.device_process import GONE, REPORT, run_devices
from madns_runtime.hardware.driven import (
    NOT_MADE_SAFE,
    DeviceProcess,
    DrivenDevice,
    allow_descriptors_of,
    exit_text,
)
from madns_runtime.hardware.guardian import guard_outputs
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.port import Hardware
from madns_runtime.hardware.status import back_off_s
from madns_runtime.plugin.context import clean_text
from madns_runtime.reactor.reactor import Reactor

LOOK_PERIOD_S: Final = 0.05
"""Time between two looks at the devices' pages."""
STALL_S: Final = 1.0
STALL_GRACE_S: Final = 0.5
"""Delay of a look after which this process stood still itself, and so may have the devices: they are given a grace, once."""
OPENING_S: Final = 5.0
"""How long agents wait for devices to be opened, once, before they are started themselves."""
OPENING_POLL_S: Final = 0.005
END_S: Final = 3.0
"""Time for the devices' processes to end in good order: to make safe, and to close their records."""
KILL_WAIT_S: Final = 1.0
NO_ROOM_S: Final = 0.5
"""Time between two attempts to start a process for which the machine has no room."""

Emit = Callable[[Mapping[str, Any]], None]


class DeviceManager:
    """
    Drives the devices of one machine.

    Args:
        launch: What the machine runs.
        tell: Told what is being done, as a driver is imported.

    Raises:
        MadnsError: A kind cannot be found, or is not what it should be; or another run has a device.
    """

    def __init__(self, launch: AgentLaunch, tell: Callable[[str], None]) -> None:
        self._launch = launch
        self._devices: dict[str, DrivenDevice] = {}
        shared: list[DrivenDevice] = []
        self._processes: list[DeviceProcess] = []
        self._claims = DeviceClaims(launch.config.run)
        allow_descriptors_of(launch.devices)
        for each in launch.devices:
            tell(f"importing the kind of device {each.kind}")
            program = prepare(each.kind, each.parameters, Path(each.base_directory))
            claims = self._claims.claim(each, program.kind, program.needs.exclusive)
            driven = DrivenDevice.share(each, program, claims)
            self._devices[driven.name] = driven
            if program.kind.can_block:
                self._processes.append(DeviceProcess([driven]))
            else:
                shared.append(driven)
        if shared:
            self._processes.append(DeviceProcess(shared))
        tell("")
        self._guarded = {name: d.seat for name, d in self._devices.items() if d.has_moving_outputs}
        self._owners: dict[str, int] = {}
        """Processes of the agents that own outputs."""
        self._guardian: socket.socket | None = None
        self._guardian_pid = 0
        self._reactor: Reactor | None = None
        self._emit: Emit = lambda event: None
        self._is_ending = False
        self._looked_s = float("inf")

    def start(self) -> None:
        """Start the guardian and the devices' processes, and wait, bounded, until each device was opened or has failed."""
        if self._guarded:
            self._start_guardian()
        for process in self._processes:
            self._start(process)
        deadline_s = monotonic() + OPENING_S
        for process in self._processes:
            while process.is_opening() and monotonic() < deadline_s:
                sleep(OPENING_POLL_S)

    def watch(self, reactor: Reactor, emit: Emit) -> None:
        """Look after them in the supervisor's loop; *emit* takes events for the operator."""
        self._reactor, self._emit = reactor, emit
        if self._guardian is not None:
            reactor.add_reader(self._guardian.fileno(), self._hear_guardian)
        for process in self._processes:
            self._listen(process)
        self._claims.tell_problem(emit)
        if self._devices:
            self._look()

    def hardware_of(self, agent: str) -> Hardware:
        """Return the devices that an agent uses; called in its process."""
        users = (driven for driven in self._devices.values() if agent in driven.ends)
        return Hardware({driven.seat.launch.name: driven.port_of(agent) for driven in users})

    def alter(self, device: str, alter: Callable[[Device], None]) -> None:
        """Have each driver of a device altered when it is made, as a verification does; before `start`."""
        self._devices[device].alter(alter)
        if device in self._guarded:
            self._guarded[device] = self._devices[device].seat

    def page_of(self, device: str) -> DevicePage:
        """Return the page of a device by its full name."""
        return self._devices[device].seat.page

    def is_guarded(self, device: str) -> bool:
        """Tell whether it has outputs that may move."""
        return device in self._guarded

    def fds_of(self, agents: Sequence[str]) -> set[int]:
        """Return the descriptors that a process of these agents keeps."""
        return {
            end.fileno()
            for driven in self._devices.values()
            for agent, end in driven.ends.items()
            if agent in agents
        }

    def agents_started(self, agents: Sequence[str], pid: int) -> None:
        """Take note of the process that agents run in: if it ends, what they own is made safe."""
        for owner in sorted({seat.launch.owner for seat in self._guarded.values()}):
            if owner in agents:
                self._owners[owner] = pid
                self._tell_guardian(guardian.WATCH, owner, pid)

    def agents_ended(self, agents: Sequence[str]) -> None:
        """Have what they own made safe: their process has ended."""
        for agent in agents:
            self._owners.pop(agent, None)
        self._tell_owner_gone(agents)

    def agent_left(self, agent: str) -> None:
        """Have what an agent owns made safe: it has ended, while its process goes on, in which it may return."""
        self._tell_guardian(guardian.LEFT, agent)
        self._tell_owner_gone((agent,))

    def _tell_owner_gone(self, agents: Sequence[str]) -> None:
        for process in self._processes:
            for driven in process.devices:
                if driven.seat.launch.owner in agents:
                    process.tell([messages.OWNER_GONE, driven.name])

    def insert_fault(self, target: str, action: str, value: float | None) -> str | None:
        """Put a fault in force around a device by its full name; return why it cannot be, or None."""
        for process in self._processes:
            for driven in process.devices:
                if driven.name != target:
                    continue
                if refusal := driven.refusal_of(action):
                    return refusal
                if process.tell([messages.FAULT, target, action, value]):
                    driven.note_fault(action, value)
                    return None
                return f"{target}: its process does not listen"
        return f"no device {target!r} here; there are {', '.join(self._devices) or 'none'}"

    # Processes ----------------------------------------------------------------------------------

    def _start_guardian(self) -> None:
        self._guardian_pid, self._guardian = fork_with_pair(partial(guard_outputs, self._guarded))
        for process in self._processes:
            for driven in process.devices:
                if process.pid and driven.name in self._guarded:
                    self._tell_guardian(guardian.DRIVES, driven.name, process.pid)
        for owner, pid in self._owners.items():
            self._tell_guardian(guardian.WATCH, owner, pid)
        if self._reactor is not None:
            self._reactor.add_reader(self._guardian.fileno(), self._hear_guardian)

    def _tell_guardian(self, *message: str | int) -> None:
        if self._guardian is not None:
            messages.send(self._guardian, list(message))

    def _start(self, process: DeviceProcess) -> None:
        config, directory = self._launch.config, Path(self._launch.directory)
        seats = [driven.seat for driven in process.devices]
        process.started_s = monotonic()
        process.killed_why = process.gave_up_why = ""
        for driven in process.devices:
            driven.seat.page.header[page.ACTIVE_S] = process.started_s
        process.pid, process.control = fork_with_pair(
            lambda control: run_devices(seats, control, config, directory)
        )
        for driven in process.devices:
            if driven.name in self._guarded:
                self._tell_guardian(guardian.DRIVES, driven.name, process.pid)
            driven.seat.page.header[page.PID] = float(process.pid)
            for action, value in driven.faults.items():
                process.tell([messages.FAULT, driven.name, action, value])
        self._listen(process)

    def _listen(self, process: DeviceProcess) -> None:
        if self._reactor is not None and process.control is not None:
            self._reactor.add_reader(process.control.fileno(), lambda: self._hear(process))

    def _hear(self, process: DeviceProcess) -> None:
        if process.control is None:
            return
        has_heard = False
        for word, *rest in messages.receive_all(process.control):
            has_heard = True
            if word == REPORT:
                for name, report in rest[0].items():
                    self._devices[name].report = report
            elif word == messages.ERROR:
                self._devices[rest[0]].blame(rest[1])
            elif word == messages.FAULT:
                self._devices[rest[0]].note_fault(rest[1], rest[2])
            elif word == GONE:
                process.gave_up_why = clean_text(str(rest[0]))
        if not has_heard and messages.is_over(process.control):  # a look may have heard all before
            self._hang_up(process)

    def _hang_up(self, process: DeviceProcess) -> None:
        """Close this side of a process that has closed its own."""
        if process.control is None:
            return
        if self._reactor is not None:
            self._reactor.remove_reader(process.control.fileno())
        process.control.close()
        process.control = None

    def _hear_guardian(self) -> None:
        if self._guardian is None:
            return
        has_heard = False
        for word, name, how in messages.receive_all(self._guardian):
            has_heard = True
            if word == guardian.SAFE:
                level = "info" if how else "error"
                text = how or NOT_MADE_SAFE
                self._emit({"event": "log", "level": level, "text": f"{name}: {text}"})
        if not has_heard and self._reactor is not None and not self._is_ending:
            self._reactor.remove_reader(self._guardian.fileno())

    def reap(self) -> None:
        """Take the exit codes of processes that have ended, and start anew what is still needed."""
        for process in self._processes:
            if not process.pid:
                continue
            pid, status = os.waitpid(process.pid, os.WNOHANG)
            if pid:
                self._ended(process, os.waitstatus_to_exitcode(status))
        if self._guardian_pid and os.waitpid(self._guardian_pid, os.WNOHANG)[0]:
            self._guardian_ended()

    def _ended(self, process: DeviceProcess, code: int) -> None:
        self._hear(process)
        self._hang_up(process)
        process.pid = 0
        for driven in process.devices:
            header = driven.seat.page.header
            if header[page.STATE] in (page.OPENING, page.OPEN):
                header[page.STATE] = page.CLOSED
            if not self._is_ending:
                driven.blame(process.killed_why or process.gave_up_why or exit_text(code))
                driven.loss = driven.why
                self._look_at(process, driven, monotonic())
        if self._is_ending:
            process.note_exit(code)
        if self._is_ending or self._reactor is None:
            return
        process.failures = 0 if monotonic() - process.started_s > 10.0 else process.failures + 1
        for driven in process.devices:
            driven.restarts += 1
        names = ", ".join(driven.name for driven in process.devices)
        start = partial(self._start_anew, names, lambda: self._start(process))
        self._reactor.call_at(monotonic() + back_off_s(process.failures), start)

    def _start_anew(self, what: str, start: Callable[[], None], *, is_told: bool = False) -> None:
        """Start a process as soon as the machine has room for it, as long as the run goes on; say once why that has to wait."""
        if self._is_ending or self._reactor is None:
            return
        try:
            start()
        except MachineError as error:  # such as of memory: what else the machine runs goes on
            text = f"{what}: {error}; it is tried again"
            if not is_told:
                self._emit({"event": "log", "level": "error", "text": text})
            again = partial(self._start_anew, what, start, is_told=True)
            self._reactor.call_at(monotonic() + NO_ROOM_S, again)

    def _guardian_ended(self) -> None:
        self._guardian_pid = 0
        if self._is_ending or self._reactor is None:
            return
        if self._guardian is not None:
            self._reactor.remove_reader(self._guardian.fileno())
            self._guardian.close()
            self._guardian = None
        self._start_anew("outputs are not guarded", self._start_guardian)

    # Statuses -----------------------------------------------------------------------------------

    def _look(self) -> None:
        """Note every device's status, tell what has changed, and give up who hangs; not right after a stall."""
        now_s = monotonic()
        stood_still = now_s - self._looked_s > STALL_S
        self._looked_s = float("inf") if stood_still else now_s
        for process in () if stood_still else self._processes:
            for driven in process.devices:
                self._look_at(process, driven, now_s)
        if self._reactor is not None and not self._is_ending:
            pause_s = STALL_GRACE_S if stood_still else LOOK_PERIOD_S
            self._reactor.call_at(now_s + pause_s, self._look)

    def _look_at(self, process: DeviceProcess, driven: DrivenDevice, now_s: float) -> None:
        status = driven.seat.page.status(driven.limits, now_s)
        if status == "ok":
            driven.forgive()
        elif process.has_words():
            self._hear(process)  # why it was closed may wait
        if driven.observe(status, now_s) is not None:
            if status == "lost":
                driven.loss = driven.why or driven.why_silent()
                driven.seat.page.loss.write(driven.loss)
            why = driven.loss if status == "lost" else ""
            self._emit({"event": "device", "device": driven.name, "status": status, "why": why})
        # Behind its reason: who reads the count finds that.
        if driven.account.counted_s is not None:
            driven.seat.page.header[page.LOSSES] = driven.account.times_lost
        silent_s = now_s - driven.seat.page.header[page.ACTIVE_S]
        if process.pid and silent_s > driven.limits.hang_s and not process.killed_why:
            process.killed_why = f"its driver did not return within {driven.limits.hang_s:g} s"
            kill(process.pid)

    # The end ------------------------------------------------------------------------------------

    def end(self, why: str) -> None:
        """Tell the devices' processes to end; returns at once."""
        if self._is_ending:
            return
        self._is_ending = True
        for driven in self._devices.values():
            driven.observe(driven.account.status, monotonic())
        for process in self._processes:
            process.tell([messages.END, why])
        self._tell_guardian(guardian.OVER)

    def close(self) -> Mapping[str, Any]:
        """End what still runs, and return what became of each device, by its full name."""
        self.end("the run is over")
        deadline_s = monotonic() + END_S
        for process in self._processes:
            self._wait(process, deadline_s)
        if self._guardian is not None:
            self._guardian.shutdown(socket.SHUT_WR)  # its sign that all is over
            wait_for(self._guardian_pid, deadline_s + KILL_WAIT_S)
            self._hear_guardian()
            self._guardian.close()
        self._claims.release()
        return {name: driven.close() for name, driven in self._devices.items()}

    def _wait(self, process: DeviceProcess, deadline_s: float) -> None:
        code = wait_for(process.pid, deadline_s)
        if code is None:
            kill(process.pid)
            wait_for(process.pid, monotonic() + KILL_WAIT_S)
            for driven in process.devices:
                driven.blame(f"its driver did not return within {END_S:g} s of the run's end")
                text = f"{driven.name}: {driven.why}"
                self._emit({"event": "log", "level": "error", "text": text})
        self._hear(process)
        self._hang_up(process)
        if process.pid and code is not None:
            process.note_exit(code)
        process.pid = 0
