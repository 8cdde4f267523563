"""Input of the checks: the facts probed on one machine, and the wishes of a run. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from cosmos_cli.doctor.finding import HERE
from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.models.scenario import Scenario
from madns_runtime.config import Agents, Deadline, Network, Scheduling

_AGENTS, _DEADLINE, _NETWORK, _SCHEDULING = Agents(count=1), Deadline(), Network(), Scheduling()


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentBound:
    """The most agents that a machine's processors are predicted to bear."""

    agents: float
    """Infinity for any number."""
    is_of_process: bool = False
    """Whether it is the one thread of a process that bears no more, rather than all processors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wants:
    """Wishes of a run: the scenario's settings, or the defaults without one."""

    scenario: str | None = None
    receive_buffer_bytes: int = _NETWORK.receive_buffer_bytes
    policy: Literal["auto", "fifo", "normal"] = _SCHEDULING.policy
    priority: int = _SCHEDULING.priority
    """Of the agents; the host's is one above."""
    lateness_ms: float = _DEADLINE.overrun_ms
    """Of a wake-up, at most."""
    tick_hz: float = _AGENTS.tick_hz
    port: int = 0
    """UDP port of the host; 0 for any."""
    agents: Mapping[str, int] = field(default_factory=dict)
    """Agents by machine, as the scenario would place them."""
    agents_per_process: int = 1
    bounds: Mapping[str, AgentBound] = field(default_factory=dict)
    """By machine that told its processors; empty in lockstep, where agents have the time that they need."""
    affinity: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """By machine, the processors that agents are to use there, where the inventory or the scenario says it."""
    machines: int = 0
    """Machines that are reached over SSH."""

    @classmethod
    def of(cls, scenario: Scenario, agents: Mapping[str, int], *, machines: int) -> Wants:
        """Return what a scenario asks for, whose agents are placed as given."""
        deadline = scenario.deadline
        return cls(
            scenario=scenario.name,
            receive_buffer_bytes=scenario.network.receive_buffer_bytes,
            policy=scenario.scheduling.policy,
            priority=scenario.scheduling.priority,
            lateness_ms=deadline.overrun_ms
            if deadline.lateness_ms is None
            else deadline.lateness_ms,
            tick_hz=scenario.agents.tick_hz,
            port=scenario.network.port,
            agents=agents,
            agents_per_process=scenario.agents.per_process,
            machines=machines,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One machine, or this computer."""

    machine: str
    told: Mapping[str, Any]
    """The answer of the verb "doctor" and, here, of `probe_here`."""
    wants: Wants
    facts: MachineFacts

    @classmethod
    def of(cls, machine: str, told: Mapping[str, Any], wants: Wants) -> Case:
        """Return the case of a machine that answered."""
        asked_s = told.get("asked_utc_s") or told["facts"]["clock"]["utc_s"]
        facts = MachineFacts.from_mapping(
            told["facts"], asked_utc_s=asked_s, answered_utc_s=asked_s
        )
        return cls(machine=machine, told=told, wants=wants, facts=facts)

    @property
    def is_here(self) -> bool:
        """Whether it is this computer."""
        return self.machine == HERE

    @property
    def agents(self) -> int:
        """Number of agents that the scenario would place there."""
        return self.wants.agents.get(self.machine, 0)

    def part(self, name: str) -> Mapping[str, Any]:
        """Return one part of what was told; empty when it was left out."""
        return self.told.get(name) or {}

    def has_capability(self, number: int) -> bool:
        """Tell whether who works there has a capability of Linux, as root has."""
        return bool(int(self.part("limits").get("capabilities") or 0) >> number & 1)

    def cure(self, setting: str, command: str) -> str:
        """Return how to set something for good: a line of the inventory, or a command for this computer."""
        return command if self.is_here else f"`{setting}` in the inventory, then `cosmos up`"

    def cure_by(self, command: str) -> str:
        """Return a command that root gives on that machine."""
        return f"sudo {command}" if self.is_here else f"`cosmos exec --sudo -- {command}`"
