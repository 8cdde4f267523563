"""The predicted capacity, as `cosmos plan` shows it, and the computers that it is predicted for."""

from __future__ import annotations

import math

from cosmos_cli.launch.capacity import Capacity, ComputerFacts
from cosmos_cli.launch.plan import LaunchPlan
from cosmos_cli.ui.console import Column, Console
from madns_runtime.lockstep.partition import processors_here

BOARD_PROCESSORS = 4
"""Processors of a machine that nobody has asked yet: those of a Raspberry Pi since its second model."""
LIMITS = (Column("limit"), Column("agents at most", is_number=True), Column("why"))


def computers_of(plan: LaunchPlan) -> list[ComputerFacts]:
    """
    Return the computers of a plan: those that are told of, as many processors as are known here.

    Machines of one address are one computer. No machine is asked: another one counts with the processors of a
    Raspberry Pi, and with speed 1.
    """
    here = "this computer"
    found: dict[str, tuple[bool, bool]] = {}
    host = here if plan.host is None or plan.host.connection == "local" else plan.host.name
    for planned in plan.machines:
        name = here if planned.machine.connection == "local" else planned.name
        found[name] = (True, name == host)
    found.setdefault(host, (False, True))
    return [
        ComputerFacts(
            name=name,
            processors=processors_here() if name == here else BOARD_PROCESSORS,
            has_agents=has_agents,
            is_host=is_host,
        )
        for name, (has_agents, is_host) in found.items()
    ]


def show_capacity(console: Console, capacity: Capacity) -> None:
    """Print every limit, like machines as one, and which comes first."""
    console.data("")
    rows: dict[tuple[str, str], list[str]] = {}
    for limit in capacity.limits:
        agents = "no limit" if math.isinf(limit.agents) else f"{limit.agents:.0f}"
        rows.setdefault((agents, limit.why), []).append(limit.name)
    console.table(
        LIMITS,
        [
            (names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more", agents, why)
            for (agents, why), names in rows.items()
        ],
    )
    if math.isinf(capacity.agents):
        console.data(f"predicted at {capacity.tick_hz:g} Hz: no limit")
    else:
        console.data(
            f"predicted at {capacity.tick_hz:g} Hz: up to {capacity.agents:.0f} agents, by {capacity.binding.name}"
        )
