"""Request to the operator, and its outcome: plain values."""

from __future__ import annotations

import dataclasses
import itertools
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Protocol

from cosmos_cli.evidence.run_documents import Problem
from cosmos_cli.launch.events import Listening, Progress
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from madns_runtime.config import AgentLaunch, DeviceLaunch, HostLaunch, RunConfig, to_mapping
from madns_runtime.plugin.registry import is_file
from madns_runtime.timing.pack_split import packs_on_machine
from madns_runtime.timing.rate import staggered

MANUAL_READY_S = 600.0
"""Time to start an agent by hand."""
SYNC_INTERVAL_S = 5.0
"""Boards lose their power more often than computers do, and their kernel keeps writes back for half a minute."""
RUN_KEY_BYTES = 32
SESSION_BYTES = 8


def make_session() -> str:
    """Return what tells this run from all others on the wire and on machines; it is no secret."""
    return secrets.token_hex(SESSION_BYTES)


@dataclass(frozen=True, slots=True, kw_only=True)
class SupervisorStart:
    """Start of a machine's supervisor: the first, or another after the machine was lost and has returned."""

    incarnation: int = 1
    first_incarnations: Mapping[str, int] = field(default_factory=dict)
    """The number of an agent's first process under this supervisor; 1 where none is named."""
    killed_before: Mapping[str, int] = field(default_factory=dict)
    """How many earlier processes of an agent were ended on purpose; 0 where none is named."""


FIRST_START = SupervisorStart()


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineConfig:
    """Differences of one machine's launch from the operator's own."""

    directory: str
    """The run's, there."""
    base_directory: str | None = None
    """The scenario's folder there; None for as on this computer."""
    driver_directory: str = ""
    """The folder there from which drivers beside the inventory are found; "" for none."""
    cpu_affinity: tuple[int, ...] = ()
    """Processors for the agents; empty for what the scenario says."""
    host_address: str | None = None
    """Address of the host from there; None for the one at which the host says that it listens."""


def config_at(config: RunConfig, place: MachineConfig) -> RunConfig:
    """Return what the processes of a run are told at *place*."""
    if place.cpu_affinity:
        scheduling = dataclasses.replace(config.scheduling, cpu_affinity=place.cpu_affinity)
        config = dataclasses.replace(config, scheduling=scheduling)
    if place.base_directory is not None:
        config = dataclasses.replace(config, base_directory=place.base_directory)
        if config.recording.sync_interval_s is None:
            config = dataclasses.replace(
                config,
                recording=dataclasses.replace(config.recording, sync_interval_s=SYNC_INTERVAL_S),
            )
    return config


def devices_at(
    devices: Sequence[DeviceLaunch], config: RunConfig, place: MachineConfig
) -> tuple[DeviceLaunch, ...]:
    """Return a machine's devices with the folders of their files as they are named at *place*."""
    if place.base_directory is None:
        return tuple(devices)
    here = Path(config.base_directory).resolve()
    found = []
    for device in devices:
        folder = Path(device.base_directory).resolve()
        inner = folder.relative_to(here) if folder.is_relative_to(here) else ""
        there = str(PurePosixPath(place.base_directory, inner))
        if is_file(device.kind) and not folder.is_relative_to(here) and place.driver_directory:
            there = place.driver_directory
        found.append(dataclasses.replace(device, base_directory=there))
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class LaunchRequest:
    """One run, on this computer and on others."""

    config: RunConfig
    directory: Path
    """The run directory; it exists."""
    machines: Mapping[str, tuple[str, ...]]
    """Each machine's agents."""
    places: Mapping[str, MachineConfig] = field(default_factory=dict)
    """Differences by machine; one that is not named is this computer."""
    host_machine: str | None = None
    """Machine of the host; None for this computer."""
    manual: tuple[str, ...] = ()
    """Agents that a person starts by hand; they are in nobody's list of *machines*' children."""
    labels: AgentLabels = NO_LABELS
    """Second names of agents."""
    is_detached: bool = False
    """Once it runs, the run goes on without its operator."""
    nice: int = 0
    """Niceness that the operator adds to its own once its children are started."""
    devices: Mapping[str, tuple[DeviceLaunch, ...]] = field(default_factory=dict)
    """Devices that each machine drives, by machine."""
    run_key_hex: str = field(default_factory=lambda: secrets.token_hex(RUN_KEY_BYTES), repr=False)
    session_hex: str = field(default_factory=make_session)

    def place_of(self, machine: str | None) -> MachineConfig:
        """Return where a machine's part of the run lives."""
        here = MachineConfig(directory=str(self.directory))
        return here if machine is None else self.places.get(machine, here)

    def host_launch(self) -> dict[str, Any]:
        """Return the host's launch line; it holds the run key."""
        place, is_lockstep = self.place_of(self.host_machine), self.config.time.is_lockstep
        launch = HostLaunch(
            config=config_at(self.config, place),
            run_key_hex=self.run_key_hex,
            session_hex=self.session_hex,
            directory=str(PurePosixPath(place.directory, "host")),
            is_detached=self.is_detached,
            reattach_s=self._reattach_s(place),
            # In lockstep the host's own processes ask all devices; without an operator it looks after them.
            devices=tuple(itertools.chain(*self.devices.values()))
            if is_lockstep or self.is_detached
            else (),
            phases_s={} if is_lockstep else self.phases_s(),
        )
        return to_mapping(launch)

    def _reattach_s(self, place: MachineConfig) -> float:
        """Return how long a part waits for its operator when the connection between them breaks, if there is one."""
        is_connected = place.base_directory is not None and not self.is_detached
        return self.config.timeouts.silence_s if is_connected else 0.0

    def agent_launch(
        self,
        machine: str,
        agents: tuple[str, ...],
        listening: Listening,
        start: SupervisorStart = FIRST_START,
    ) -> dict[str, Any]:
        """
        Return the launch line of a supervisor; it holds the run key.

        Args:
            machine: Where.
            agents: Whom it runs.
            listening: Where the host listens.
            start: Which of that machine's supervisors it is.
        """
        place, phases_s = self.place_of(machine), self.phases_s()
        launch = AgentLaunch(
            config=config_at(self.config, place),
            run_key_hex=self.run_key_hex,
            session_hex=self.session_hex,
            machine=machine,
            agents=agents,
            phases_s={name: phases_s[name] for name in agents if name in phases_s},
            host_address=place.host_address or listening.address,
            host_port=listening.port,
            directory=place.directory,
            is_detached=self.is_detached,
            reattach_s=self._reattach_s(place),
            life=start.incarnation,
            first_incarnations=start.first_incarnations,
            killed_before=start.killed_before,
            devices=devices_at(self.devices.get(machine, ()), self.config, place),
        )
        return to_mapping(launch)

    def phases_s(self) -> dict[str, float]:
        """Return the phase of each agent, s: the run's packs divide the period, machine by machine, whoever is gone by then."""
        agents = self.config.agents
        is_apart = agents.per_process > 1 and len(self.machines) > 1
        groups = tuple(self.machines.values()) if is_apart else (agents.resolved_names(),)
        packs = [pack for names in groups for pack in packs_on_machine(names, agents.per_process)]
        phases_s = staggered(len(packs), agents.tick_hz, phase=agents.phase)
        return {
            name: phase_s for pack, phase_s in zip(packs, phases_s, strict=True) for name in pack
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class LaunchOutcome:
    """End of the run, for the collector to judge."""

    host_result: Mapping[str, Any] | None
    """The host's report at its end; None if it could not give one."""
    interruption: Literal["no", "clean", "at once"] = "no"
    problems: tuple[Problem, ...] = ()
    """Problems, each a sentence that names who and why."""
    is_detached: bool = False
    """Whether the run has not ended, but goes on without its operator."""


class View(Protocol):
    """Receiver of the operator's talk."""

    def say(self, text: str, level: str = "info") -> None:
        """Show a sentence."""

    def state(self, state: str) -> None:
        """The host is in another state."""

    def progress(self, progress: Progress) -> None:
        """Show how the run fares."""

    def work(self, what: str, share: float) -> None:
        """Show what is done with the records after the run, and how far it is, 0 to 1."""

    def close(self) -> None:
        """Leave the terminal as it was; harmless when repeated."""


def with_manual_agents(config: RunConfig, manual: tuple[str, ...]) -> RunConfig:
    """Return *config* with time enough to start agents by hand."""
    if not manual or config.timeouts.agents_ready_s >= MANUAL_READY_S:
        return config
    return dataclasses.replace(
        config, timeouts=dataclasses.replace(config.timeouts, agents_ready_s=MANUAL_READY_S)
    )
