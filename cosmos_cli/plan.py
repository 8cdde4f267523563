"""
From a scenario and machines to a launch plan. Pure: the same input gives the same plan.

Agents are dealt in blocks of neighbours, so that the machines' loads differ by one agent at most.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from cosmos_cli.errors import InputError
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.scenario import Scenario

LOOPBACK = Machine(name="loopback", address="127.0.0.1", connection="local")
"""This computer, where a run without an inventory takes place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachinePlan:
    """What one machine runs."""

    name: str
    address: str
    connection: Literal["local", "ssh"]
    processes: tuple[tuple[str, ...], ...]
    """The names of the agents in each process."""

    @property
    def agents(self) -> tuple[str, ...]:
        """The names of all agents here, in order."""
        return tuple(name for process in self.processes for name in process)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for plan.json."""
        return {
            "address": self.address,
            "connection": self.connection,
            "agents": list(self.agents),
            "processes": [list(process) for process in self.processes],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class LaunchPlan:
    """Which machine runs which agents, in which processes."""

    scenario: str
    machines: tuple[MachinePlan, ...]
    """Machines that run at least one agent, in the inventory's order."""
    idle: tuple[str, ...] = ()
    """Names of machines that are left without an agent."""

    @property
    def agents_by_machine(self) -> Mapping[str, tuple[str, ...]]:
        """The names of the agents that each machine runs."""
        return {machine.name: machine.agents for machine in self.machines}

    @property
    def is_local(self) -> bool:
        """Whether every machine is this computer."""
        return all(machine.connection == "local" for machine in self.machines)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for plan.json."""
        return {
            "scenario": self.scenario,
            "machines": {machine.name: machine.to_mapping() for machine in self.machines},
            "idle": list(self.idle),
        }


def make_plan(scenario: Scenario, machines: Sequence[Machine] = (LOOPBACK,)) -> LaunchPlan:
    """
    Place the scenario's agents on machines.

    Args:
        scenario: The scenario.
        machines: At least one; by default this computer alone.

    Raises:
        InputError: There is no machine.
    """
    if not machines:
        raise InputError("expected at least one machine, got none; check the inventory")
    names = scenario.agents.resolved_names()
    placed, idle, start = [], [], 0
    for index, machine in enumerate(machines):
        share = _share(len(names), len(machines), index)
        if share:
            processes = _chunks(names[start : start + share], scenario.agents.per_process)
            placed.append(
                MachinePlan(
                    name=machine.name,
                    address=machine.address,
                    connection=machine.connection,
                    processes=processes,
                )
            )
        else:
            idle.append(machine.name)
        start += share
    return LaunchPlan(scenario=scenario.name, machines=tuple(placed), idle=tuple(idle))


def _share(total: int, parts: int, index: int) -> int:
    """Return the size of block *index* when *total* things are dealt in *parts* blocks, larger ones first."""
    return total // parts + (index < total % parts)


def _chunks(names: Sequence[str], size: int) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(names[start : start + size]) for start in range(0, len(names), size))
