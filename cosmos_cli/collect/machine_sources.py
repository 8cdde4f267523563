"""Machines that recorded a part of a run, by plan.json: where they are, and what is theirs. Pure but for `RecordingMachines.read`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.target import Target

AGENTS, MACHINES, HOST, DEVICES = "agents", "machines", "host", "devices"
OPERATOR = "this computer"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingMachine:
    """One machine that recorded a part of a run in a directory of its own."""

    target: Target
    directory: str
    """The run's, there."""

    @property
    def machine(self) -> str:
        """Name of the machine."""
        return self.target.name

    @property
    def state(self) -> str:
        """The machine's register of processes."""
        return Layout(self.target.root).state

    @property
    def where(self) -> dict[str, str]:
        """The same two as the machine is asked by them."""
        return {"directory": self.directory, "state": self.state}


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingMachines:
    """All of them, and who of all machines recorded for whom."""

    remote: tuple[RecordingMachine, ...] = ()
    machine_of_agent: Mapping[str, str] = field(default_factory=dict)
    machine_of_device: Mapping[str, str] = field(default_factory=dict)
    """By full names, such as pi22/imu."""
    host_machine: str | None = None
    """Machine of the run's host; None when it was this computer."""

    @classmethod
    def read(cls, run: RunDirectory) -> RecordingMachines:
        """Return what the plan of a run says; of a plan that cannot be read, nothing."""
        plan = run.read_json(run.plan_json) or {}
        machines = _mappings(plan.get("machines"))
        named = _mappings({HOST: plan.get("host")}).get(HOST, {})
        session = str(plan.get("session") or "")
        host = _source(named, run.name, session)
        found = {name: _source(entry, run.name, session) for name, entry in machines.items()}
        remote = {source.machine: source for source in (*found.values(), host) if source}
        return cls(
            remote=tuple(remote.values()),
            machine_of_agent={
                str(agent): name for name in machines for agent in _listed(machines[name])
            },
            machine_of_device={
                str(device): name
                for name, devices in _lists(plan.get("devices"))
                for device in devices
            },
            host_machine=host.machine if host else None,
        )

    def machine_of(self, source: str) -> str | None:
        """Return which machine recorded for an agent, or for the host; None if it was this computer."""
        machine = self.host_machine if source == HOST else self.machine_of_agent.get(source)
        return machine if any(each.machine == machine for each in self.remote) else None

    def owner_of(self, path: str) -> str | None:
        """Return whose a path in the run directory is; None for one that nobody is known to write."""
        top, *rest = path.split("/")
        if top == HOST and rest:
            return self.host_machine or OPERATOR
        if len(rest) > 1 and top == MACHINES:
            return rest[0]
        if len(rest) > 1 and top == AGENTS:
            return self.machine_of_agent.get(rest[0])
        if (
            len(rest) > 1 and top == DEVICES
        ):  # of an agent, or of a machine, which may be called alike
            agents = self.machine_of_agent.get(rest[0], rest[0])
            return self.machine_of_device.get("/".join(rest[:2]), agents)
        return None


def _source(entry: Mapping[str, Any], run: str, session_hex: str) -> RecordingMachine | None:
    """Return what lies elsewhere; None for this computer, which records in the run directory itself."""
    mapping, directory = entry.get("target"), entry.get("directory")
    if not isinstance(mapping, Mapping):
        return None
    try:
        target = Target.from_mapping(mapping)
    except TypeError:
        return None
    if target.connection == "local":
        return None
    if not isinstance(directory, str):
        directory = Layout(target.root).run(run, session_hex)
    return RecordingMachine(target=target, directory=directory)


def _mappings(value: object) -> dict[str, Mapping[str, Any]]:
    items = value.items() if isinstance(value, Mapping) else ()
    return {str(name): entry for name, entry in items if isinstance(entry, Mapping)}


def _listed(entry: Mapping[str, Any]) -> list[Any]:
    agents = entry.get("agents")
    return agents if isinstance(agents, list) else []


def _lists(value: object) -> list[tuple[str, list[Any]]]:
    items = value.items() if isinstance(value, Mapping) else ()
    return [(str(name), each) for name, each in items if isinstance(each, list)]
