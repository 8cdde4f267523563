"""The predicted capacity, as `cosmos plan` shows it, and the computers that it is predicted for."""

from __future__ import annotations

import math

from cosmos_cli.fleet.target import target_of
from cosmos_cli.launch.capacity import Capacity, ComputerFacts
from cosmos_cli.launch.plan import LaunchPlan
from cosmos_cli.models.inventory import Machine
from cosmos_cli.ui.console import Column, Console
from madns_runtime.lockstep.partition import processors_here

HERE: tuple[str, int | None] = ("", None)
"""Address and port, by which computers are told apart without asking them, of the operator's own."""
BOARD_PROCESSORS = 4
"""Processors of a machine that nobody has asked yet: those of a Raspberry Pi since its second model."""
HERE_NAME = "this computer"
LIMITS = (Column("limit"), Column("agents at most", is_number=True), Column("why"))


def computers_of(plan: LaunchPlan) -> list[ComputerFacts]:
    """
    Return the computers of a plan, as many agents as they may run: as many processors as are known here.

    Machines of one address and port are one computer. No machine is asked: another one counts with the processors of a
    Raspberry Pi, and with speed 1.
    """
    with_agents = [*(planned.machine for planned in plan.machines), *plan.spare]
    host = _place_of(plan.host)
    names: dict[tuple[str, int | None], str] = {}
    for machine in (*with_agents, plan.host):
        place = _place_of(machine)
        names.setdefault(place, HERE_NAME if machine is None or place == HERE else machine.name)
    are_used = {_place_of(machine) for machine in with_agents}
    return [
        ComputerFacts(
            name=name,
            processors=processors_here() if place == HERE else BOARD_PROCESSORS,
            has_agents=place in are_used,
            is_host=place == host,
        )
        for place, name in names.items()
    ]


def _place_of(machine: Machine | None) -> tuple[str, int | None]:
    if machine is None or machine.connection == "local":
        return HERE
    target = target_of(machine)
    return target.address, target.port


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
