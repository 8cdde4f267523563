"""The demand of a scenario's simulation on host and network."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.models.document import Document
from cosmos_cli.models.plugin_process import Tell, ask_apart
from cosmos_cli.models.separate_process import SeparateFailure
from madns_runtime.config import Agents
from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import Demand
from madns_runtime.plugin.queries import ask_demand
from madns_runtime.plugin.registry import parse_parameters, resolve


def ask_plugin_demand(
    document: Document, parameters: Mapping[str, Any], agents: Agents, base_directory: Path
) -> Demand:
    """
    Return what the simulation asks of host and network.

    Args:
        document: The scenario.
        parameters: As `ask_plugin` returned them.
        agents: Of the scenario.
        base_directory: Its folder.

    Raises:
        PluginError: It raised, returned no proper Demand, or did not come to an end.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    spec = str(document.value["simulation"])

    def work(tell: Tell) -> Demand:
        tell(f"importing {spec}")
        simulation = resolve(spec, base_directory)
        tell(f"demand() of {spec}")
        return ask_demand(
            str(simulation.demand),
            base_directory,
            parameters=parse_parameters(simulation, parameters),
            agents=agents.count,
            tick_hz=agents.tick_hz,
        )

    try:
        return ask_apart(work, Demand, document, spec)
    except SeparateFailure as failure:
        raise PluginError(str(failure)) from None
