"""The plan's word on how many agents fit, to stand beside what was measured: the one place that asks it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cosmos_cli.launch.feasibility import BITS_PER_BYTE, Resources
from cosmos_cli.launch.plan import make_plan
from cosmos_cli.launch.plan_view import BANDWIDTH_MBIT_DEFAULT, feasibility_of, latency_of
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
    latency_s, _ = latency_of(plan)
    resources = Resources(
        workers=scenario.scenario.executor.workers,
        bandwidth_bytes_s=BANDWIDTH_MBIT_DEFAULT * 1e6 / BITS_PER_BYTE,
        latency_s=latency_s,
    )
    found = feasibility_of(scenario, resources)
    if found is None:
        return None
    binding = found.binding
    source = f"inequality {binding.number}"
    if math.isinf(binding.breaks_at):
        return CapacityPrediction(agents=None, source=source)
    return CapacityPrediction(agents=int(binding.breaks_at) - 1, source=source)
