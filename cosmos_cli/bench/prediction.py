"""The plan's word on how many agents fit, to stand beside what was measured: the one place that asks it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cosmos_cli.launch.capacity import predict_capacity
from cosmos_cli.launch.capacity_view import computers_of
from cosmos_cli.launch.plan import make_plan
from cosmos_cli.launch.plan_view import demand_of, latency_of, resources_of
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.loading import ScenarioFile


@dataclass(frozen=True, slots=True, kw_only=True)
class CapacityPrediction:
    """Predicted largest number of agents."""

    agents: int | None
    """None where the plan sees no limit."""
    source: str
    """The limit, in a few words."""


def predict(
    scenario: ScenarioFile,
    machines: Sequence[Machine],
    *,
    per_process: int,
    host: str | None = None,
) -> CapacityPrediction | None:
    """
    Return what `cosmos plan` predicts for a scenario's agents on machines; None if the simulation has no demand.

    Args:
        scenario: Its number of agents does not matter.
        machines: Those of the inventory, or this computer alone.
        per_process: Agents in one process, where there are so many.
        host: Name of the machine that runs the host, None for the operator's own.
    """
    plan = make_plan(
        scenario.scenario, machines, host=host, fault_at=scenario.fault, labels=scenario.labels
    )
    demand = demand_of(scenario)
    if demand is None:
        return None
    latency_s, _ = latency_of(plan, given_ms=scenario.scenario.plan.latency_ms)
    resources = resources_of(scenario, plan, latency_s)
    # The scenario has those of a first trial, of few agents, who fill no process.
    agents = replace(scenario.scenario.agents, per_process=per_process)
    filled = scenario.scenario.model_copy(update={"agents": agents})
    found = predict_capacity(filled, demand, computers_of(plan), resources)
    most = None if math.isinf(found.agents) else int(found.agents)
    return CapacityPrediction(agents=most, source=found.binding.name)
