"""Which machine drives which devices in a run, and which agents use them: the scenario's `hardware` on the inventory's."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cosmos_cli.errors import InputError
from cosmos_cli.launch.plan import LaunchPlan, fault_without_place, make_plan
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.models.device_kinds import DeviceQuestion, KindAnswer, ask_kinds
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.hardware import agent_faults, device_faults
from cosmos_cli.models.inventory.devices import MachineDevice, driven_devices
from cosmos_cli.models.inventory.machine import Machine
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.scenario import Scenario
from madns_runtime.config import DeviceLaunch, ScenarioDevice
from madns_runtime.plugin.registry import is_file

NOT_ARMED = "the scenario says no `armed: true` under hardware"
NOT_PERMITTED = "the inventory says no `outputs: true` for it"


def plan_devices(
    scenario_file: ScenarioFile, plan: LaunchPlan
) -> dict[str, tuple[DeviceLaunch, ...]]:
    """
    Return the devices of each machine in a run.

    Raises:
        InputError: With every fault.
    """
    return DevicePlanner(
        scenario=scenario_file.scenario,
        base_directory=scenario_file.base_directory,
        agents_by_machine=plan.agents_by_machine,
        machines=plan.involved,
        labels=scenario_file.labels,
    ).plan(scenario_file.fault)


def look_at_devices(
    scenario_file: ScenarioFile,
    machines: Sequence[Machine],
    *,
    host: str | None,
    warn: Callable[[str], None],
) -> None:
    """
    Look for what is wrong with a scenario's devices on all machines of an inventory, before any is made ready.

    Args:
        scenario_file: The scenario.
        machines: All of them, whatever --limit leaves.
        host: Machine of the host; None for this computer.
        warn: Told that devices were not looked at, as nobody could say who runs where.

    Raises:
        InputError: With every fault.
    """
    hardware = scenario_file.scenario.hardware
    if not (hardware.use or hardware.devices):
        return
    try:
        plan = make_plan(
            scenario_file.scenario,
            machines,
            host=host,
            fault_at=scenario_file.fault,
            labels=scenario_file.labels,
        )
    except InputError as error:
        name = scenario_file.scenario.name
        warn(f"the devices of {name} were not looked at, as it cannot be run there: {error}")
        return
    plan_devices(scenario_file, plan)


@dataclass(slots=True, kw_only=True)
class DevicePlanner:
    """
    Collects the devices of a run, and what is wrong with them.

    Args:
        scenario: The scenario.
        base_directory: Its folder.
        agents_by_machine: Names of the agents on each machine.
        machines: The machines, by name.
        labels: Second names of agents.
    """

    scenario: Scenario
    base_directory: Path
    agents_by_machine: Mapping[str, Sequence[str]]
    machines: Mapping[str, Machine]
    labels: AgentLabels = NO_LABELS
    faults: list[tuple[ValuePath, str]] = field(default_factory=list)
    found: dict[str, dict[str, DeviceLaunch]] = field(default_factory=dict)
    """Launches of devices, by machine and full name."""
    owners: dict[str, str] = field(default_factory=dict)
    """Owners that the scenario names, by full name of the device."""
    answers: dict[str, KindAnswer] = field(default_factory=dict)
    """Answers of kinds, by what they were asked."""

    def plan(self, fault_at: object = None) -> dict[str, tuple[DeviceLaunch, ...]]:
        """
        Return the devices of each machine.

        Raises:
            InputError: With every fault.
        """
        for index, use in enumerate(self.scenario.hardware.use):
            self._use(("hardware", "use", index), use.devices, use.agents, use.owner)
        for index, device in enumerate(self.scenario.hardware.devices):
            self._give(("hardware", "devices", index), device)
        if self.faults:
            where = fault_at if callable(fault_at) else fault_without_place
            raise InputError(faults=[where(path, text) for path, text in self.faults])
        return {machine: tuple(devices.values()) for machine, devices in self.found.items()}

    # Devices of the inventory ---------------------------------------------------------------------

    def _use(
        self, path: ValuePath, devices: Sequence[str], patterns: Sequence[str], owner: str
    ) -> None:
        """Let agents use devices of their machines."""
        chosen = set(self._agents(path, patterns))
        for place, name in enumerate(devices):
            homes = {
                machine: driven[name]
                for machine in self.agents_by_machine
                if name in (driven := driven_devices(self._listed(machine)))
            }
            if not homes:
                self.faults.append(((*path, "devices", place), self._no_device(name)))
            users = 0
            for machine, device in homes.items():
                own = [agent for agent in self.agents_by_machine[machine] if agent in chosen]
                users += len(own)
                if own:
                    self._add((*path, "devices", place), machine, device, own, owner)
            if homes and not users:
                text = f"none of the agents that may use {name} runs on {', '.join(homes)}: place one there"
                self.faults.append(((*path, "devices", place), text))

    def _add(
        self, path: ValuePath, machine: str, device: MachineDevice, users: Sequence[str], owner: str
    ) -> None:
        folder = self.machines[machine].devices_folder
        answer = self._answer(path, f"{machine}/{device.name}: ", device, folder)
        if answer is None:
            return
        self._look_at(path, machine, device, answer)
        earlier = self.found.get(machine, {}).get(f"{machine}/{device.name}")
        all_users = (*(earlier.users if earlier else ()), *users)
        if owner in all_users:
            claimed = self.owners.setdefault(f"{machine}/{device.name}", owner)
            if claimed != owner:
                text = f"{device.name} of {machine}: both {claimed} and {owner} are to own it, and it takes one"
                self.faults.append((path, text))
        owner = owner if owner in all_users else (earlier.owner if earlier else "")
        if answer.has_outputs and not owner and len(set(all_users)) == 1:
            owner = all_users[0]
        is_moved = answer.has_outputs and self.scenario.hardware.armed and device.outputs
        if is_moved and not owner:
            count = len(set(all_users))
            text = f"{device.name} of {machine} has outputs and {count} agents there use it: name one as its owner"
            self.faults.append((path, text))
        may_move, why_not = self._may_move(device.outputs)
        launch = DeviceLaunch(
            name=device.name,
            place=machine,
            kind=device.kind,
            base_directory=str(folder),
            rate_hz=device.rate_hz or answer.rate_hz,
            parameters=device.parameters,
            serial=device.serial,
            users=tuple(dict.fromkeys(all_users)),
            owner=owner,
            may_move=may_move and bool(owner),
            why_not=why_not,
            hang_s=device.hang_s,
            frozen_s=device.frozen_s,
            late_s=self.scenario.hardware.stimulus_late_ms * 1e-3,
            seed=self.scenario.seed,
        )
        self.found.setdefault(machine, {})[launch.full_name] = launch

    def _look_at(
        self, path: ValuePath, machine: str, device: MachineDevice, answer: KindAnswer
    ) -> None:
        """Enter what does not fit between a machine's device and its kind, its machine, and what is sent there."""
        full_name = f"{machine}/{device.name}"
        texts = [
            f"{full_name}: {device.kind} has no input {name!r} (frozen_s of the inventory)"
            for name in device.frozen_s
            if name not in answer.inputs
        ]
        if device.rate_hz is not None and device.rate_hz > answer.rate_hz_max:
            texts.append(
                f"{full_name}: expected a rate_hz <= {answer.rate_hz_max:g} ({device.kind}), got {device.rate_hz:g}"
            )
        serials = Counter(each.serial for each in driven_devices(self._listed(machine)).values())
        if device.serial and serials[device.serial] > 1:
            texts.append(f"{full_name}: two devices of {machine} have the serial {device.serial!r}")
        is_local = self.machines[machine].connection == "local"
        if not is_local and is_file(device.kind) and device.kind.startswith("/"):
            texts.append(
                f"{full_name}: {device.kind}: expected a path from the inventory's folder, as in ./driver.py:NAME:"
                " machines are sent what is named so"
            )
        self.faults += [(path, text) for text in texts]

    def _may_move(self, is_permitted: bool) -> tuple[bool, str]:
        if not self.scenario.hardware.armed:
            return False, NOT_ARMED
        return (True, "") if is_permitted else (False, NOT_PERMITTED)

    # Devices of the scenario ------------------------------------------------------------------------

    def _give(self, path: ValuePath, device: ScenarioDevice) -> None:
        """Give each of some agents a device of its own."""
        answer = self._answer((*path, "kind"), "", device, self.base_directory)
        if answer is None:
            return
        faults = list(
            device_faults(path, device, answer, is_lockstep=self.scenario.time.is_lockstep)
        )
        if faults:
            self.faults += faults
            return
        chosen = set(self._agents(path, device.agents))
        for machine, agents in self.agents_by_machine.items():
            for agent in agents:
                if agent in chosen:
                    if text := self._taken(machine, agent, device.name):
                        self.faults.append(((*path, "name"), text))
                        return
                    launch = DeviceLaunch(
                        name=device.name,
                        place=agent,
                        kind=device.kind,
                        base_directory=str(self.base_directory),
                        rate_hz=device.rate_hz or answer.rate_hz,
                        parameters=device.parameters,
                        users=(agent,),
                        owner=agent,
                        may_move=self.scenario.hardware.armed,
                        why_not="" if self.scenario.hardware.armed else NOT_ARMED,
                        hang_s=device.hang_s,
                        frozen_s=device.frozen_s,
                        late_s=self.scenario.hardware.stimulus_late_ms * 1e-3,
                        seed=zlib.crc32(agent.encode(), self.scenario.seed & 0xFFFF_FFFF),
                    )
                    self.found.setdefault(machine, {})[launch.full_name] = launch

    def _taken(self, machine: str, agent: str, name: str) -> str:
        """Return what has a name already that an agent's own device is to have; empty if nothing has."""
        used = self.found.get(machine, {}).get(f"{machine}/{name}")
        if used is not None and agent in used.users:
            return f"{agent} uses {name} of {machine} already (hardware.use): name one otherwise"
        # A machine may be called like an agent that runs elsewhere.
        if any(f"{agent}/{name}" in devices for devices in self.found.values()):
            return f"{name} of {agent} and of the machine {agent} have one name: name one otherwise"
        return ""

    # Both ---------------------------------------------------------------------------------------------

    def _answer(
        self,
        path: ValuePath,
        head: str,
        device: MachineDevice | ScenarioDevice,
        base_directory: Path,
    ) -> KindAnswer | None:
        """Return what a device's kind says; None and faults, which begin with *head*, if it refuses."""
        key = repr((device.kind, dict(device.parameters), base_directory))
        if key not in self.answers:
            question = DeviceQuestion(
                path=(),
                kind=device.kind,
                parameters=device.parameters,
                base_directory=base_directory,
            )
            limit_s = self.scenario.timeouts.loading_s
            self.answers[key] = ask_kinds([question], limit_s=limit_s)[0]
        answer = self.answers[key]
        for fault in answer.faults:
            self.faults.append((path, f"{head}{fault.path}{': ' * bool(fault.path)}{fault.text}"))
        if answer.faults:
            return None
        if self.scenario.time.is_lockstep and not answer.follows_simulated_time:
            text = f"{device.kind} follows the wall clock, and time.mode lockstep does not: use playback or synthetic there"
            self.faults.append((path, text))
            return None
        return answer

    def _agents(self, path: ValuePath, patterns: Sequence[str]) -> list[str]:
        names = self.scenario.agents.resolved_names()
        self.faults += agent_faults((*path, "agents"), patterns, names, self.labels)
        return self.labels.like_any(patterns, names)

    def _listed(self, machine: str) -> Sequence[str | MachineDevice]:
        return self.machines[machine].variables.cosmos_devices or ()

    def _no_device(self, name: str) -> str:
        known = sorted(
            {
                each
                for machine in self.agents_by_machine
                for each in driven_devices(self._listed(machine))
            }
        )
        there = (
            f"there are {', '.join(known)}"
            if known
            else "no machine there has one that can be driven"
        )
        return f"no machine with agents has a device {name!r} ({there}): list it in cosmos_devices, with its kind"
