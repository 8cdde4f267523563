"""The plan's word on how many agents fit, to stand beside what was measured: the one place that asks it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
    """What limits it, in a few words."""


def predict(scenario: ScenarioFile, machines: Sequence[Machine]) -> CapacityPrediction | None:
    """
    Return what `cosmos plan` predicts for a scenario's agents on machines; None if the simulation has no demand.

    Args:
        scenario: Its number of agents does not matter.
        machines: Those of the inventory, or this computer alone.
    """
    plan = make_plan(scenario.scenario, machines, fault_at=scenario.fault, labels=scenario.labels)
    demand = demand_of(scenario)
    if demand is None:
        return None
    latency_s, _ = latency_of(plan, given_ms=scenario.scenario.plan.latency_ms)
    resources = resources_of(scenario, latency_s)
    found = predict_capacity(scenario.scenario, demand, computers_of(plan), resources)
    agents = None if math.isinf(found.agents) else int(found.agents)
    return CapacityPrediction(agents=agents, source=found.binding.name)
