"""
A worker: the process of some of the run's agents, which does one thing after the other as the host says.

It blocks on its line to the host and on nothing else, and ends when that line closes. What it is doing
stands in memory that the host can read, so that a worker that hangs or is killed can be blamed exactly.
"""

from __future__ import annotations

import contextlib
import faulthandler
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from time import monotonic
from typing import Any, NoReturn

from madns_runtime.errors import MadnsError
from madns_runtime.faults.step_faults import StepFaults
from madns_runtime.lockstep import frames
from madns_runtime.lockstep.agent import LockstepAgent, WorkerCore
from madns_runtime.lockstep.assignment import Assignment
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.frames import POSITIONS, encode_frame
from madns_runtime.lockstep.messages import decode
from madns_runtime.lockstep.stray_forks import StrayForks
from madns_runtime.lockstep.worker_line import HostGone, WorkerLine
from madns_runtime.lockstep.worker_losses import WorkerLosses
from madns_runtime.plugin.api import Tick
from madns_runtime.plugin.context import clean_text
from madns_runtime.plugin.half import RoleProgram
from madns_runtime.processes import register
from madns_runtime.protocol.codec import unpack
from madns_runtime.protocol.messages import ActionOrder, AgentFault, Delivery, TransmissionRefusal
from madns_runtime.reactor.forking import end_child, leave_parent
from madns_runtime.reactor.scheduling import freeze_garbage
from madns_runtime.reactor.watchdog import end_after_hang_up
from madns_runtime.recording.newest_values import Value
from madns_runtime.timeline.fault_kinds import KILL

HANG_GRACE_S = 2.0
"""Time beyond that for shutdown: a worker that hangs in a plug-in ends by force when its host is gone."""
STACK_SIGNAL = signal.SIGUSR1
"""Makes a worker write where it is to standard error."""
TERMINATED = "its process was ended by SIGTERM"


class AgentFailed(Exception):
    """An agent cannot go on; the text says why."""

    def __init__(self, index: int, reason: str) -> None:
        super().__init__(reason)
        self.index = index
        self.reason = reason


class _Ends(Exception):
    """The process ends, and the run goes on without its agents."""


def run_worker(assignment: Assignment, line: socket.socket) -> NoReturn:
    """Run as a forked child; never returns."""
    code = 1
    try:
        leave_parent(keep={line.fileno()})
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is the operator's
        faulthandler.register(STACK_SIGNAL, file=sys.__stderr__ or 2)
        timeouts = assignment.config.timeouts
        end_after_hang_up(line.fileno(), timeouts.shutdown_s + HANG_GRACE_S)
        names = assignment.config.agents.resolved_names()
        own = ",".join(names[index] for index in assignment.agents)
        with register(assignment.config.run, "agent", own, assignment.directory):
            code = Worker(assignment, line).run()
    except BaseException:  # noqa: BLE001 - the last frame of a process; the host sees the line close
        # A plug-in may have put anything in the place of stderr.
        with contextlib.suppress(Exception):
            traceback.print_exc()
    finally:
        end_child(code)


class Worker:
    """
    The agents of one process.

    Args:
        assignment: Whom to run.
        line: To the host.
    """

    def __init__(self, assignment: Assignment, line: socket.socket) -> None:
        config = assignment.config
        self._assignment = assignment
        self._line = WorkerLine(line)
        self._position = assignment.position
        self._clock = SimulatedClock(-config.timeouts.start_lead_s)
        self._period_s = 1.0 / config.agents.tick_hz
        self._tick_hz = config.agents.tick_hz
        self._agents: list[LockstepAgent] = []
        self._losses = WorkerLosses()
        self._goes_on = False
        """Whether the run goes on without an agent that fails now."""
        self._forks = StrayForks(assignment.position)
        self._faults: dict[int, StepFaults] = {}
        self._core: WorkerCore
        self._flush_interval_s = config.recording.flush_interval_s
        self._flushed_s = monotonic()
        self._orders: dict[int, Callable[..., bytes]] = {
            frames.SETUP: self._set_up,
            frames.TICK: self._tick,
            frames.DRAIN: self._drain,
            frames.FINISH: self._finish,
            frames.RETURN: self._return,
            frames.FAULT: self._fault,
        }

    def run(self) -> int:
        """Carry out orders until the last, and return the exit code."""
        self._line.heed_sigterm()
        self._forks.watch()
        try:
            self._answer(self._load)
            while (order := self._line.next_order())[0] != frames.STOP:
                self._answer(partial(self._orders[order[0]], *order[1:]))
            self._close_all(order[1], is_told=True)
        except _Ends:
            self._close_all(TERMINATED, is_told=False)
            return 1
        except HostGone:
            self._close_all("its host is gone", is_told=False)
            return 1
        return 0 if order[1] is None else 1

    def _answer(self, carry_out: Callable[[], bytes]) -> None:
        try:
            self._check_terminated()
            answer = carry_out()
        except AgentFailed as failure:
            answer = encode_frame(frames.FAILED, failure.index, clean_text(failure.reason))
        self._forks.end_stray(self._line)
        self._position[0] = frames.IDLE
        self._line.say(answer)

    def _check_terminated(self) -> None:
        if self._line.is_terminated and self._goes_on:
            raise _Ends
        if self._line.is_terminated:
            raise AgentFailed(self._assignment.agents[0], TERMINATED)

    def _load(self) -> bytes:
        config, index = self._assignment.config, self._assignment.agents[0]
        self._position[0] = index * POSITIONS + frames.LOADING
        try:
            self._core = WorkerCore(
                config=config,
                directory=self._assignment.directory,
                program=RoleProgram.load(config, "agent"),
                clock=self._clock,
                devices=self._assignment.devices,
            )
            for index in self._assignment.agents:
                self._agents.append(LockstepAgent(index, self._core))
        except MadnsError as error:
            raise AgentFailed(index, str(error)) from error
        return encode_frame(frames.READY)

    def _set_up(self, initial: list[tuple[int, bytes]]) -> bytes:
        self._goes_on = self._assignment.config.on_agent_loss == "continue"
        for agent, (_, packed) in zip(self._agents, initial, strict=True):
            self._set_up_one(agent, packed)
        freeze_garbage()  # what set-up made stays: no collection walks it in mid-run
        return self._done()

    def _set_up_one(
        self, agent: LockstepAgent, packed: bytes, *, has_devices: bool = False
    ) -> None:
        self._position[0] = agent.index * POSITIONS + frames.SETTING_UP
        agent.journal.event("start")
        try:
            self._ask(agent, agent.begin, has_devices)
            self._call(agent, "setup", agent.context, unpack(packed))
        except AgentFailed as failure:
            self._lose(agent, failure)

    def _tick(self, number: int, messages: list[tuple[int, bytes]]) -> bytes:
        if number == 0:
            for agent in self._agents:
                agent.is_running = True
        self._clock.t_s = t_s = number / self._tick_hz
        if messages:
            self._hand_out(messages)
        tick = Tick(number, t_s, self._period_s, 0.0, 0, t_s)
        agents = self._unhindered(number, t_s) if self._faults else iter(self._agents)
        while not self._step_all(agents, tick):
            pass  # one of them is lost; the next have their turn
        self._losses.follow_devices(t_s)
        if monotonic() - self._flushed_s <= self._flush_interval_s:
            return self._done()
        self._flush()
        return self._done([(agent.index, agent.columns.read()) for agent in self._agents])

    def _step_all(self, agents: Iterator[LockstepAgent], tick: Tick) -> bool:
        """Step one agent after the other; return False after one that is lost by it."""
        t_s, position, has_medium = tick.t_s, self._position, self._core.program.has_medium
        agent, forks = None, self._forks
        try:
            for agent in agents:
                if has_medium and (heard := agent.mailbox.due(t_s)):
                    self._hear(agent, heard)
                if agent.has_devices:
                    self._look_at_devices(agent, t_s)
                position[0] = agent.stepping
                agent.step(tick)
                if forks.forked_at is not None:
                    forks.end_stray(self._line)
                if agent.look is not None:
                    agent.look(t_s)
        except AgentFailed as failure:
            assert agent is not None
            self._lose(agent, failure)
            return False
        except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
            assert agent is not None
            failed = AgentFailed(agent.index, str(agent.half.failure("step", error)))
            failed.__cause__ = error
            self._lose(agent, failed)
            return False
        return True

    def _unhindered(self, number: int, t_s: float) -> Iterator[LockstepAgent]:
        """Yield the agents that no fault keeps from the step of tick *number*; what the others recorded last still holds."""
        for agent in self._agents:
            faults = self._faults.get(agent.index)
            if faults is None or not faults.withholds(number):
                yield agent
            else:
                self._position[0] = agent.stepping
                agent.rest(t_s)

    def _hear(self, agent: LockstepAgent, heard: Sequence[Delivery]) -> None:
        for delivery in heard:
            self._position[0] = agent.index * POSITIONS + frames.HEARING
            self._call(agent, "hear", delivery)

    def _look_at_devices(self, agent: LockstepAgent, t_s: float) -> None:
        """Take the devices' samples up to *t_s*, and tell the half whose status has changed."""
        self._position[0] = agent.stepping
        for name, status in self._ask(agent, agent.devices.advance, t_s):
            agent.journal.event("device", device=name, status=status)
            self._call(agent, "device_changed", name, status)

    def _drain(self, t_s: float, messages: list[tuple[int, bytes]]) -> bytes:
        self._check_terminated()
        self._clock.t_s = t_s
        self._hand_out(messages)
        return self._done()

    def _finish(self, t_s: float) -> bytes:
        self._clock.t_s = t_s
        summaries, outbox = [], self._core.outbox
        for agent in self._agents:
            self._position[0] = agent.index * POSITIONS + frames.FINISHING
            try:
                summary = self._call(agent, "finish")
            except AgentFailed as failure:
                self._lose(agent, failure)
                continue
            counts = agent.mailbox.counts()
            newest = agent.columns.read()
            summaries.append((agent.index, summary, agent.deadlines_broken, counts, newest))
        self._forks.wait()
        answer = encode_frame(frames.SUMMARIES, outbox, (), self._losses.take(), summaries)
        outbox.clear()
        return answer

    def _done(self, newest: Sequence[tuple[int, list[Value]]] = ()) -> bytes:
        outbox = self._core.outbox
        losses = (self._losses.take(),) if self._losses else ()
        answer = encode_frame(frames.DONE, outbox, newest, *losses)
        outbox.clear()
        return answer

    def _hand_out(self, messages: list[tuple[int, bytes]]) -> None:
        agents = {agent.index: agent for agent in self._agents}
        for index, body in messages:
            agent, message = agents[index], decode(body)
            if self._losses and self._losses.unheard(index):
                continue
            if isinstance(message, Delivery):
                agent.mailbox.add(message)
                continue
            agent.mailbox.begin(self._clock.t_s)
            is_action = isinstance(message, ActionOrder)
            doing = frames.REFUSED if isinstance(message, TransmissionRefusal) else frames.RECEIVING
            self._position[0] = index * POSITIONS + (frames.ACTING if is_action else doing)
            try:
                if is_action:
                    self._ask(agent, agent.actions.take, message)
                else:
                    self._call(agent, frames.METHODS[doing], message)
            except AgentFailed as failure:
                self._lose(agent, failure)

    # Losses and faults -------------------------------------------------------------------------------

    def _lose(self, agent: LockstepAgent, failure: AgentFailed) -> None:
        """
        Run an agent no more, and close its records.

        Raises:
            AgentFailed: The run does not go on without it.
        """
        self._forks.end_stray(self._line)
        if not self._goes_on:
            raise failure
        self._forks.abandon(agent.index, agent.abandon, self._line)
        self._agents = [other for other in self._agents if other is not agent]
        self._faults.pop(agent.index, None)
        self._losses.add(agent, clean_text(failure.reason))

    def _return(self, number: int, returning: list[tuple[int, int, bytes]]) -> bytes:
        """Make lost agents anew, and set them up, before tick *number*."""
        self._clock.t_s = number / self._tick_hz
        for index, incarnation, packed in returning:
            self._position[0] = index * POSITIONS + frames.LOADING
            devices = self._losses.devices_of(index)
            try:
                agent = LockstepAgent(index, self._core, incarnation=incarnation, devices=devices)
            except MadnsError as error:
                raise AgentFailed(index, str(error)) from error
            self._agents = sorted((*self._agents, agent), key=lambda each: each.index)
            self._set_up_one(agent, packed, has_devices=devices is not None)
            agent.is_running = True  # as between machines: what sets itself up has no clock yet
        return self._done()

    def _fault(self, t_s: float, told: list[Any], indices: list[int]) -> bytes:
        """Begin or end a fault of agents at simulated time *t_s*: of their steps, or their loss."""
        fault = AgentFault(*told)
        self._clock.t_s = t_s
        for agent in [each for each in self._agents if each.index in indices]:
            if fault.word == KILL:
                agent.is_killed = True
                agent.journal.event("killed", **fault.loss)
                self._lose(agent, AgentFailed(agent.index, fault.reason))
                continue
            faults = self._faults.setdefault(agent.index, StepFaults())
            if fault.begins:
                faults.begin(fault.number, fault.word, fault.value)
                agent.journal.event(f"{fault.word}_begins", factor=fault.value)
            elif faults.end(fault.number):
                agent.journal.event(
                    f"{fault.word}_ends", factor=fault.value, ticks_withheld=faults.withheld
                )
            if not faults.are_in_force:
                del self._faults[agent.index]
        return self._done()

    # Faults and records ------------------------------------------------------------------------------

    def _call(self, agent: LockstepAgent, name: str, *arguments: Any) -> Any:
        return self._ask(agent, agent.half.call, name, *arguments)

    def _ask(self, agent: LockstepAgent, ask: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return ask(*arguments)
        except MadnsError as error:
            raise AgentFailed(agent.index, str(error)) from error
        finally:
            self._forks.end_stray(self._line)

    def _flush(self) -> None:
        for agent in self._agents:
            try:
                agent.journal.recorder.flush()
            except MadnsError as error:
                raise AgentFailed(agent.index, str(error)) from error
        self._flushed_s = monotonic()

    def _close_all(self, reason: str | None, *, is_told: bool) -> None:
        for agent in self._agents:
            self._position[0] = agent.index * POSITIONS + frames.CLOSING
            if reason is not None:
                agent.journal.emergency(reason)
                self._forks.abandon(agent.index, agent.abandon, self._line)
            losses = agent.journal.device_losses(agent.devices.hardware.losses())
            counts = {**losses, **agent.journal.close().to_mapping()}
            if agent.devices:
                counts["devices"] = agent.devices.close()
            if is_told:
                self._line.say(encode_frame(frames.CLOSED, agent.index, counts))
        for index, counts in self._losses.close_devices().items():
            if is_told:
                self._line.say(encode_frame(frames.CLOSED, index, {"devices": counts}))
        known = {agent.index for agent in self._agents}
        for index in self._assignment.agents if is_told and not self._goes_on else ():
            if index not in known:
                self._line.say(encode_frame(frames.CLOSED, index, {}))  # it never opened any
