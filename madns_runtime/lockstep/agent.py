"""
One agent in lockstep: its half, records, mailbox and devices, which its worker drives by simulated time alone.

Nothing here waits. What is sent is kept until the worker answers the host; devices are asked before each step.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from madns_runtime.conditions.tap import ConditionTap
from madns_runtime.config import DeviceLaunch, RunConfig
from madns_runtime.errors import ConfigurationError, PluginError
from madns_runtime.hardware.inline import InlineDevice
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.hardware.port import Hardware
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.frames import POSITIONS, STEPPING, Sent
from madns_runtime.lockstep.messages import Allowance, encode
from madns_runtime.lockstep.recorder import open_journal
from madns_runtime.medium.mailbox import Mailbox
from madns_runtime.plain_values import from_mapping
from madns_runtime.plugin.agent_actions import AgentActions
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.context import PeerContext, check_sending, describe_exception
from madns_runtime.plugin.device_view import DeviceStatus
from madns_runtime.plugin.half import Half, RoleProgram
from madns_runtime.protocol.codec import encode_message
from madns_runtime.protocol.messages import ActionOrder, ConditionMet, Service, Transmission
from madns_runtime.recording.newest_values import NewestValues
from madns_runtime.timeline.action import ActionRefused
from madns_runtime.timeline.kinds import DEVICE_FAULT, DeviceFault


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerCore:
    """State that the agents of one worker share."""

    config: RunConfig
    directory: Path
    """The run directory."""
    program: RoleProgram
    clock: SimulatedClock
    devices: tuple[DeviceLaunch, ...] = ()
    """Devices of all agents."""
    outbox: list[Sent] = field(default_factory=list)
    """Messages sent since the last answer to the host, in order."""


class LockstepAgent:
    """
    One agent.

    Args:
        index: Its number among the run's agents, from 0.
        core: What it shares with the others of its process.
        incarnation: Which incarnation of the agent this is.
        devices: Those of the incarnation before, if its worker has them.

    Raises:
        MachineError: It cannot record.
        HalfFailed: Its half cannot be made, of the first incarnation: that of a later one is made by `begin`.
    """

    def __init__(
        self,
        index: int,
        core: WorkerCore,
        *,
        incarnation: int = 1,
        devices: AgentDevices | None = None,
    ) -> None:
        self.index = index
        self.name = core.config.agents.resolved_names()[index]
        self._clock = core.clock
        self._outbox = core.outbox
        self.conditions = ConditionTap(
            self.name,
            core.config.conditions,
            tick_hz=core.config.agents.tick_hz,
            now_s=core.clock.now_s,
            report=self._condition_met,
        )
        self.look = self.conditions.look if self.conditions.must_look else None
        """Called after each step with its simulated time, s; None if no condition has to hold for a while."""
        self.journal = open_journal(
            core.directory / "agents" / self.name,
            core.config,
            source=self.name,
            clock=core.clock,
            tap=self.conditions,
            incarnation=incarnation,
        )
        self.columns = NewestValues(self.journal.recorder, core.program.columns)
        self._core = core
        self.is_made = False
        """Whether its half is made."""
        self.is_killed = False
        """Whether a fault has ended it on purpose."""
        self.stepping = index * POSITIONS + STEPPING
        self.is_running = False
        self.deadlines_broken = 0
        self._allowance = Allowance()
        self.mailbox = Mailbox(
            self.name,
            core.config.agents.resolved_names(),
            has_medium=core.program.has_medium,
            post=self._transmit,
            incarnation=incarnation,
        )
        self.devices = devices or AgentDevices(
            [each for each in core.devices if self.name in each.users],
            core.config,
            directory=core.directory,
            clock=core.clock,
        )
        self.has_devices = bool(self.devices)
        self.context = PeerContext(
            name=self.name,
            config=core.config,
            parameters=core.program.parameters_of(self.name),
            journal=self.journal,
            now_s=core.clock.now_s,
            send=self.send,
            mailbox=self.mailbox,
            hardware=self.devices.hardware,
        )
        if incarnation == 1:
            self._make_half()

    def _make_half(self) -> None:
        program = self._core.program
        self.half = Half(program.make, self.journal.say)
        self.step = self.half.simulation.step
        self.actions = AgentActions(
            self.name,
            program.actions,
            call=self.half.call,
            journal=self.journal,
            own={DEVICE_FAULT.word: self.devices.take_fault},
        )
        self.is_made = True

    def begin(self, has_devices: bool) -> None:
        """
        Open its devices unless *has_devices*, those of an earlier incarnation, and make the half of a later one.

        Raises:
            PluginError: A driver raised, or the half cannot be made; the text says where.
        """
        if not has_devices:
            self.devices.open()
        if not self.is_made:
            self._make_half()

    def abandon(self) -> None:
        """Have its half, if it was made, let go of what it has started."""
        if self.is_made:
            self.half.abandon()

    def send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> int | None:
        """Send to the host's half or to other agents; see `plugin.api.Context.send`."""
        if to != HOST:
            return self.mailbox.send(to, message, service, deadline_s)
        check_sending(to, (HOST,), service, deadline_s, is_running=self.is_running)
        t_s = self._clock.t_s
        body = encode(message, service)
        self._allowance.take(len(body), t_s)
        if deadline_s is not None and deadline_s < t_s:  # it arrives when it is sent
            self.deadlines_broken += 1
            self.journal.event("sync_deadline_broken", late_s=t_s - deadline_s)
        self._outbox.append(Sent(self.index, int(service), body))
        return None

    def rest(self, t_s: float) -> None:
        """Let the tick at *t_s* pass without a step: the devices go on, and what was recorded last still holds."""
        if self.has_devices:
            self.devices.follow(t_s)
        if self.look is not None:
            self.look(t_s)

    def _condition_met(self, number: int, agent: str, t_s: float) -> None:
        del agent  # this one
        body = encode_message(ConditionMet(number, t_s))
        self._outbox.append(Sent(self.index, int(Service.RELIABLE), body))

    def _transmit(self, transmission: Transmission) -> None:
        body = encode_message(transmission)
        self._allowance.take(len(body), self._clock.t_s)
        self._outbox.append(Sent(self.index, int(Service.RELIABLE), body))


class AgentDevices:
    """
    The devices of one agent.

    Args:
        launches: What it uses.
        config: The run.
        directory: The run directory.
        clock: Simulated time.

    Raises:
        MadnsError: A kind cannot be found, does not follow simulated time, or cannot record.
    """

    def __init__(
        self,
        launches: Iterable[DeviceLaunch],
        config: RunConfig,
        *,
        directory: Path,
        clock: SimulatedClock,
    ) -> None:
        self._devices = []
        for launch in launches:
            program = prepare(launch.kind, launch.parameters, Path(launch.base_directory))
            folder = directory / "devices" / launch.place / launch.name
            journal = open_journal(folder, config, source=launch.full_name, clock=clock)
            records = DeviceRecords(journal, program.channels)
            device = InlineDevice(launch, program, records, now_s=clock.now_s)
            self._devices.append(device)
        self.hardware = Hardware({device.name: device.port for device in self._devices})

    def __bool__(self) -> bool:
        return bool(self._devices)

    def open(self) -> None:
        """
        Open all.

        Raises:
            PluginError: A driver raised; the text says where.
        """
        for device in self._devices:
            _with_blame(device.name, "open", device.open)

    def advance(self, t_s: float) -> list[tuple[str, DeviceStatus]]:
        """
        Take all samples up to *t_s*, and return the devices whose status has changed.

        Raises:
            PluginError: A driver raised; the text says where.
        """
        for device in self._devices:
            _with_blame(device.name, "sample_at", device.advance, t_s)
        return self.hardware.changes()

    def follow(self, t_s: float) -> None:
        """Take all samples up to *t_s* while their agent takes no step; what a driver raises is raised at its next."""
        for device in self._devices:
            device.follow(t_s)

    def owner_gone(self) -> None:
        """Make all safe: the agent has ended."""
        for device in self._devices:
            device.owner_gone()

    def take_fault(self, order: ActionOrder) -> None:
        """
        Insert a fault around a device, or clear all of it, at the time of the order.

        Raises:
            ActionRefused: There is no such device, or the fault is none.
        """
        fault = from_mapping(DeviceFault, order.parameters)
        for device in self._devices:
            if device.name != fault.device:
                continue
            word, value = ("clear", None) if order.is_end else (fault.fault, fault.value)
            try:
                device.insert_fault(word, value, order.t_s)
            except ConfigurationError as error:
                raise ActionRefused(str(error)) from None
            return
        known = ", ".join(each.name for each in self._devices) or "none"
        raise ActionRefused(f"this agent uses no device {fault.device!r}; it uses {known}")

    def close(self) -> dict[str, Any]:
        """Close all, and return what the run came to, by device."""
        return {device.name: device.close() for device in self._devices}


def _with_blame(name: str, doing: str, call: Any, *arguments: Any) -> None:
    """
    Call a driver.

    Raises:
        PluginError: It raised; the text says where.
    """
    try:
        call(*arguments)
    except BaseException as error:
        raise PluginError(describe_exception(error, f"device {name}: {doing}")) from error
