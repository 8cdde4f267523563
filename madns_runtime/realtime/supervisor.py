"""
A machine's agents: forked from one preloaded parent, watched, restarted, and never left behind.

The parent holds the write end of a life line; every child polls its read end and ends when it closes.
"""

from __future__ import annotations

import encodings.idna  # noqa: F401 - what a first connection imports, here for all that are forked
import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import orjson

from madns_runtime.config import AgentLaunch
from madns_runtime.errors import MachineError, MadnsError
from madns_runtime.hardware.manager import DeviceManager
from madns_runtime.health.sampler import SAMPLER_TIMEOUT_S, start_sampler
from madns_runtime.health.stress import start_stress, stop_stress
from madns_runtime.partial_file import write_whole
from madns_runtime.plugin.half import RoleProgram
from madns_runtime.processes import register
from madns_runtime.reactor.descriptors import ready
from madns_runtime.reactor.forking import end_child, leave_parent
from madns_runtime.reactor.operator_link import OPERATOR_GONE, OperatorLink, tell_loading
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.reattachment import way_back_of
from madns_runtime.reactor.scheduling import freeze_garbage, outlive_parent
from madns_runtime.realtime.agent_calls import AgentCalls, LoopSeat
from madns_runtime.realtime.agent_process import AgentProcess, SupervisorCalls
from madns_runtime.realtime.agent_report import how_ended
from madns_runtime.realtime.host_end import watch_host_end
from madns_runtime.realtime.outcome_pipe import OutcomePipe
from madns_runtime.signal_names import signal_name

RESTART_DELAY_S = 0.2
KILL_GRACE_S = 3.0
"""Time beyond that for shutdown: a process that cannot even do that is killed."""
KILL_WAIT_S = 2.0
FLUSH_TIMEOUT_S = 2.0


@dataclass(slots=True)
class SupervisedProcess:
    """One process of agents."""

    agents: tuple[str, ...]
    pid: int
    incarnation: int
    calls: AgentCalls
    killed_before: int = 0
    """How many processes of these agents a fault had ended on purpose before it: no failures, see agents.restarts_max."""
    reason: str | None = None
    may_restart: bool = True
    """Permission to start it again: granted to a killed one, not to one that ended by order or with the run."""
    has_ended_well: bool = False
    is_killed: bool = False
    """Whether a fault has ended it on purpose."""
    returns_after_s: float | None = None
    """Time from then to its return, s; None for never."""


class Supervisor:
    """
    Runs a machine's agents until they have ended or the operator is gone.

    Args:
        launch: Which agents, and where the host is.
        fds: Where the operator's commands come from and events go to; the same one twice for an agent started by hand.
        pending: What had already come behind the launch document.
    """

    def __init__(self, launch: AgentLaunch, fds: tuple[int, int], pending: bytes) -> None:
        config = launch.config
        self._launch = launch
        self._is_by_hand = fds[0] == fds[1]
        # Loaded before the forks: the children share the parent's pages.
        self._program = RoleProgram.load(config, "agent", tell=partial(tell_loading, fds[1]))
        machine_directory = Path(launch.directory) / "machines" / launch.machine
        self._sampler = start_sampler(
            machine_directory,
            run=config.run,
            machine=launch.machine,
            settings=config.health,
            recording=config.recording,
            incarnation=launch.life,
        )
        self._stress = start_stress(config.health.stress_workers)
        self._devices = DeviceManager(launch, tell=partial(tell_loading, fds[1]))
        self._life_read_fd, self._life_write_fd = os.pipe()
        self._outcomes = OutcomePipe()
        self._children: dict[int, SupervisedProcess] = {}
        self._is_ending = self._is_run_over = False
        self._failed = False
        freeze_garbage()
        self._devices.start()
        agents, size = launch.agents, config.agents.per_process
        self._to_fork = [agents[i : i + size] for i in range(0, len(agents), size)]
        first = launch.first_incarnation
        started = [self._fork(each, incarnation=first(each)) for each in self._to_fork]
        self._reactor = Reactor()
        self._operator = OperatorLink(
            self._reactor,
            fds,
            on_command=self._command,
            on_gone=partial(self._end, OPERATOR_GONE),
            pending=pending,
            is_detached=launch.is_detached,
            way_back=way_back_of(launch, machine_directory, launch.life),
        )
        for child in started:
            child.killed_before = launch.killed_before.get(child.agents[0], 0)
            self._tell_started(child)

    def run(self) -> int:
        """Run to the end and return the process's exit code: 0 if every agent ended as ordered."""
        outlive_parent()
        if self._launch.is_detached:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
            watch_host_end(self._launch, self._reactor, self._children, self._end)
        reactor = self._reactor
        reactor.on_signal(signal.SIGCHLD, self._reap)
        reactor.on_signal(signal.SIGTERM, lambda: self._end("SIGTERM"))
        # A terminal's Ctrl-C is the operator's, but for who was started by hand, on a terminal of its own.
        reactor.on_signal(signal.SIGINT, lambda: self._end("SIGINT") if self._is_by_hand else None)
        reactor.add_reader(self._outcomes.read_fd, self._read_outcomes)
        self._devices.watch(reactor, self._operator.emit)
        self._reap()
        reactor.run()
        return self._close()

    # Children --------------------------------------------------------------------------------------

    def _fork(self, agents: tuple[str, ...], *, incarnation: int) -> SupervisedProcess:
        sys.stdout.flush()
        sys.stderr.flush()
        calls = AgentCalls()
        try:
            pid = os.fork()
        except OSError as error:
            told = f"cannot start the process of {', '.join(agents)}: {error.strerror}"
            raise MachineError(told) from error
        if pid == 0:
            self._run_child(agents, incarnation, calls)
        child = SupervisedProcess(agents, pid, incarnation, calls)
        self._children[pid] = child
        self._devices.agents_started(agents, pid)
        return child

    def _run_child(self, agents: tuple[str, ...], incarnation: int, calls: AgentCalls) -> None:
        """Run as a child, and never return."""
        code = 1
        try:
            shared = self._devices.fds_of(agents)
            leave_parent(keep={self._life_read_fd, self._outcomes.write_fd, *shared})
            with register(
                self._launch.config.run, "agent", ",".join(agents), self._launch.directory
            ) as entry:
                process = AgentProcess(
                    self._launch,
                    [
                        LoopSeat(name, number, calls, self._devices.hardware_of(name))
                        for number, name in enumerate(agents)
                    ],
                    replace(self._program, incarnation=incarnation),
                    life_fd=self._life_read_fd,
                    supervisor=SupervisorCalls(
                        hardware_of=self._devices.hardware_of,
                        tell_killed=partial(self._outcomes.write_killed, entry),
                        tell_left=self._outcomes.write_left,
                    ),
                )
                outcomes = process.run()
            code = 0 if all(outcome.as_ordered for outcome in outcomes.values()) else 1
            self._outcomes.write_outcomes(outcomes)
        except MadnsError as error:
            self._outcomes.write_failure(str(error))
        except BaseException as error:  # noqa: BLE001 - the last frame of a process; it is told below
            self._outcomes.write_failure(f"{type(error).__name__}: {error}")
            sys.excepthook(type(error), error, error.__traceback__)
        finally:
            end_child(code)

    def _read_outcomes(self) -> None:
        for told in self._outcomes.read():
            child = self._children.get(told["pid"])
            if child is None:
                continue
            if "left" in told:
                self._devices.agent_left(told["agent"])
                continue
            if "killed" in told:
                child.is_killed, child.returns_after_s = True, told["returns_after_s"]
                continue
            if told.get("is_run_over"):  # the host's word reaches nobody who is away
                self._is_run_over = True
                self._to_fork.clear()
            if told["as_ordered"]:
                child.has_ended_well = True
                continue
            child.may_restart = child.may_restart and bool(told["may_restart"])
            if child.reason is None:
                is_ones = len(child.agents) > 1 and told["agent"]
                child.reason = f"{told['agent']}: {told['reason']}" if is_ones else told["reason"]

    def _reap(self) -> None:
        for child in list(self._children.values()):
            pid, status = os.waitpid(child.pid, os.WNOHANG)
            if pid:
                self._child_ended(child, status)
        self._devices.reap()
        if not self._children and not self._to_fork:
            self._reactor.stop()

    def _child_ended(self, child: SupervisedProcess, status: int) -> None:
        code = os.waitstatus_to_exitcode(status)
        while ready([self._outcomes.read_fd], [], 0)[0]:
            self._read_outcomes()
        where = child.calls.interrupted(child.agents)
        if code == 0 and not child.has_ended_well:
            child.reason = f"its process ended by itself, exit code 0{where}"
        del self._children[child.pid]
        self._devices.agents_ended(child.agents)
        killed_by = signal_name(-code) if code < 0 else None
        how = how_ended(code, killed_by, child.reason, where=where)
        has_failed = code != 0 or not child.has_ended_well
        will_restart = has_failed and not self._is_ending and self._may_restart(child)
        self._failed = self._failed or (has_failed and not child.is_killed)
        if self._is_ending and code > 0 and child.reason is None:
            self._tell_killed(
                child, f"; machines/{self._launch.machine}/stderr.txt shows where it hung"
            )
        for agent in child.agents:
            self._operator.emit(
                {
                    "event": "exited",
                    "agent": agent,
                    "pid": child.pid,
                    "code": code if code >= 0 and not (has_failed and code == 0) else None,
                    "signal": killed_by,
                    "how": how,
                    "on_purpose": child.is_killed,
                    "will_restart": will_restart,
                }
            )
        if will_restart:
            self._to_fork.append(child.agents)
            self._restart_in(max(child.returns_after_s or 0.0, RESTART_DELAY_S), child)

    def _may_restart(self, child: SupervisedProcess) -> bool:
        """Tell whether a process that failed is started again: by a fault's own word, or by the scenario's."""
        if self._is_run_over:
            return False
        if child.is_killed:
            return child.returns_after_s is not None
        return (
            child.may_restart
            and not self._operator.is_silent  # a cut link: the operator will start them again
            and self._launch.config.on_agent_loss == "continue"
            and child.incarnation - child.killed_before <= self._launch.config.agents.restarts_max
        )

    def _restart_in(self, wait_s: float, child: SupervisedProcess) -> None:
        self._reactor.call_at(self._reactor.now_s() + wait_s, partial(self._restart, child))

    def _restart(self, child: SupervisedProcess) -> None:
        if self._is_ending or self._is_run_over:
            self._reap()
        elif self._operator.is_cut:  # it comes back first, or all is over
            self._restart_in(RESTART_DELAY_S, child)
        else:
            try:
                anew = self._fork(child.agents, incarnation=child.incarnation + 1)
            except MachineError as error:  # such as of memory: the machine's other agents go on
                self._put_off(child, str(error))
                return
            anew.killed_before = child.killed_before + child.is_killed
            self._tell_started(anew)

    def _put_off(self, child: SupervisedProcess, why: str) -> None:
        """Try again in a moment, as long as the run goes on; say why once."""
        if child.reason != why:
            child.reason = why
            text = f"{why}; it is tried again every {RESTART_DELAY_S:g} s"
            self._operator.emit({"event": "log", "level": "warning", "text": text})
        self._restart_in(RESTART_DELAY_S, child)

    def _tell_started(self, child: SupervisedProcess) -> None:
        if child.agents in self._to_fork:
            self._to_fork.remove(child.agents)
        for agent in child.agents:
            self._operator.emit(
                {
                    "event": "started",
                    "agent": agent,
                    "pid": child.pid,
                    "incarnation": child.incarnation,
                }
            )

    # The end ---------------------------------------------------------------------------------------

    def _command(self, command: Mapping[str, Any]) -> None:
        if command.get("command") == "stop":
            self._end(str(command.get("reason", "stopped by the operator")))
        elif command.get("command") == "inject":
            self._inject(command)
        else:
            self._operator.refuse(command)

    def _inject(self, command: Mapping[str, Any]) -> None:
        """Put a fault in force around a device, and say what became of the order."""
        target, action, value = command.get("target"), command.get("action"), command.get("value")
        refusal = self._devices.insert_fault(str(target), str(action), value)
        told = {"event": "injected", "order": command.get("order"), "refusal": refusal}
        self._operator.emit({**told, "target": target, "action": action})

    def _end(self, reason: str) -> None:
        """Close the life line; who does not end by it in time is killed."""
        if self._is_ending:
            return
        self._is_ending = True
        self._to_fork.clear()
        self._devices.end(reason)
        # A byte for each, so that they can tell an order from the death of this process.
        os.write(self._life_write_fd, bytes(len(self._children)))
        os.close(self._life_write_fd)
        grace_s = self._launch.config.timeouts.shutdown_s + KILL_GRACE_S
        self._reactor.call_at(self._reactor.now_s() + grace_s, self._kill)
        self._operator.emit({"event": "log", "level": "info", "text": f"ending: {reason}"})
        if not self._children:
            self._reactor.stop()

    def _kill(self) -> None:
        for child in self._children.values():
            os.kill(child.pid, signal.SIGKILL)
            self._tell_killed(child)
        # One that not even this ends hangs in the kernel; it is left to whoever reaps this process.
        self._reactor.call_at(self._reactor.now_s() + KILL_WAIT_S, self._reactor.stop)

    def _tell_killed(self, child: SupervisedProcess, hint: str = "") -> None:
        text = f"{', '.join(child.agents)} did not end in time and was killed{hint}"
        self._operator.emit({"event": "log", "level": "error", "text": text})

    def _close(self) -> int:
        if not self._is_ending:
            os.close(self._life_write_fd)
        stop_stress(self._stress, timeout_s=2.0)
        devices = self._devices.close()
        self._record_devices(devices)
        health = self._sampler.wait(SAMPLER_TIMEOUT_S)
        self._operator.emit({"event": "finished", "health": health, "devices": devices})
        self._operator.flush(FLUSH_TIMEOUT_S)
        self._operator.close()
        self._reactor.close()
        return 1 if self._failed else 0

    def _record_devices(self, devices: Mapping[str, Any]) -> None:
        """Leave the devices' account beside the machine's records: whoever judges the run reads it there."""
        if not devices:
            return
        number = f".{self._launch.life}" if self._launch.life > 1 else ""
        path = Path(
            self._launch.directory, "machines", self._launch.machine, f"devices{number}.json"
        )
        try:
            write_whole(path, orjson.dumps(devices, option=orjson.OPT_SERIALIZE_NUMPY))
        except OSError as error:
            text = f"the account of the devices cannot be written: {path}: {error.strerror}"
            self._operator.emit({"event": "log", "level": "error", "text": text})
