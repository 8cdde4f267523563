"""Needs of machines for their devices: for those that hang on them, and for those that a scenario gives its agents."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cosmos_cli.models.device_kinds import DeviceQuestion, KindAnswer, ask_kinds
from cosmos_cli.models.inventory.devices import MachineDevice, driven_devices
from madns_runtime.hardware.contract import Needs
from madns_runtime.plugin.registry import is_file

if TYPE_CHECKING:  # importing these takes longer than all that is done with them here
    from cosmos_cli.models.inventory import Machine
    from cosmos_cli.models.loading import ScenarioFile
    from madns_runtime.config import ScenarioDevice

LINE_KEY: Final = re.compile(r"(?P<word>[a-z_]+)=(?P<key>[A-Za-z0-9_]+)=")
"""Begin of a line such as dtparam=i2c_arm=on, of which config.txt is to hold one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceNeeds:
    """One device, and what a machine needs for it."""

    device: str
    kind: str
    needs: Needs
    fault: str = ""
    """Why its needs are not known; empty where they are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineNeeds:
    """Needs of one machine for all its devices; each thing once, in the order of the devices."""

    devices: tuple[DeviceNeeds, ...] = ()
    driver_files: tuple[str, ...] = ()
    """Kinds that are files, such as ./driver.py:Imu, as `devices_folder` of the machine sees them."""

    @property
    def packages(self) -> tuple[str, ...]:
        """System packages."""
        return tuple(self._users("packages"))

    @property
    def requirements(self) -> tuple[str, ...]:
        """Python requirements."""
        return tuple(self._users("requirements"))

    @property
    def groups(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the devices by group whose members may open them."""
        return self._users("groups")

    @property
    def boot_lines(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the devices by line of the boot configuration."""
        return self._users("boot_lines")

    @property
    def sees_system(self) -> bool:
        """Whether modules are wanted that only the system's own packages bring."""
        return any(each.needs.system_modules for each in self.devices)

    @property
    def faults(self) -> tuple[str, ...]:
        """Sentences on devices whose needs are not known."""
        return tuple(
            f"device {each.device}: what it needs is not known: {each.fault}"
            for each in self.devices
            if each.fault
        )

    def _users(self, what: str) -> dict[str, tuple[str, ...]]:
        found: dict[str, tuple[str, ...]] = {}
        for each in self.devices:
            for item in getattr(each.needs, what):
                found[item] = (*found.get(item, ()), each.device)
        return found


NO_NEEDS: Final = MachineNeeds()


def line_pattern(line: str) -> str:
    """Return a regular expression of the lines of config.txt that *line* replaces: commented out, or of another value."""
    found = LINE_KEY.match(line)
    if found and found["word"] == "dtparam":
        return rf"^\s*#?\s*{found['word']}={found['key']}="
    return rf"^\s*#?\s*{re.escape(line)}\s*$"


def needs_of_machines(
    machines: Sequence[Machine], scenario_file: ScenarioFile | None = None
) -> dict[str, MachineNeeds]:
    """
    Return what each machine needs for its devices, by name.

    These are all devices that its inventory lists as mappings, those of its bare names that the scenario uses, and the
    scenario's own devices, wherever their agents will run: so the same is found before a run and when it starts.

    Args:
        machines: Which.
        scenario_file: What they are made ready for; None for no scenario.
    """
    own = scenario_file.scenario.hardware.devices if scenario_file else ()
    used = {
        name
        for use in (scenario_file.scenario.hardware.use if scenario_file else ())
        for name in use.devices
    }
    asked: list[tuple[str, MachineDevice | ScenarioDevice, Path]] = []
    for machine in machines:
        folder = machine.devices_folder
        asked += [(machine.name, each, folder) for each in _devices_of(machine, used)]
    if scenario_file is not None:
        asked += [("", each, scenario_file.base_directory) for each in own]
    answers = ask_kinds([_question(device, folder) for _, device, folder in asked])
    found = [
        (name, _needs(device, answer))
        for (name, device, _), answer in zip(asked, answers, strict=True)
    ]
    return {
        machine.name: MachineNeeds(
            devices=tuple(needs for name, needs in found if name in (machine.name, "")),
            driver_files=tuple(
                dict.fromkeys(
                    device.kind
                    for name, device, _ in asked
                    if name == machine.name and is_file(device.kind)
                )
            ),
        )
        for machine in machines
    }


def _devices_of(machine: Machine, used: set[str]) -> Iterator[MachineDevice]:
    """Yield the devices that count: a bare name is a label, unless a scenario uses it as a device."""
    listed = machine.variables.cosmos_devices or ()
    mappings = {each.name for each in listed if isinstance(each, MachineDevice)}
    for name, device in driven_devices(listed).items():
        if name in mappings or name in used:
            yield device


def _question(device: MachineDevice | ScenarioDevice, folder: Path) -> DeviceQuestion:
    return DeviceQuestion(
        path=(), kind=device.kind, parameters=device.parameters, base_directory=folder
    )


def _needs(device: MachineDevice | ScenarioDevice, answer: KindAnswer) -> DeviceNeeds:
    fault = answer.faults[0].text if answer.faults else ""
    return DeviceNeeds(device=device.name, kind=device.kind, needs=answer.needs, fault=fault)
