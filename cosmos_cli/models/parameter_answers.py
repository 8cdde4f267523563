"""Answers of a simulation that follow from one set of parameters, and those of all agents of a scenario together. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cosmos_cli.models.declared_streams import AgentStreams
from madns_runtime.agent_parameters import AgentParameters
from madns_runtime.plugin.api import DeclaredStream, DeviceUse, PlaceUse


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterAnswers:
    """Consequences of one set of parameters."""

    agents: tuple[str, ...] = ()
    """For which it holds; empty for all others."""
    parameters: dict[str, Any]
    streams: tuple[DeclaredStream, ...] | None
    device_uses: tuple[DeviceUse, ...]
    place_uses: tuple[PlaceUse, ...]


def of_all_agents(own: ParameterAnswers, rules: Sequence[ParameterAnswers]) -> dict[str, Any]:
    """Return the answers of all sets of parameters together, each for its agents, as fields of `PluginAnswers`."""
    ruled = {agent for rule in rules for agent in rule.agents}
    return {
        "agent_parameters": tuple(
            AgentParameters(agents=rule.agents, parameters=rule.parameters) for rule in rules
        ),
        "streams": own.streams,
        "agent_streams": tuple(
            AgentStreams(agents=rule.agents, streams=rule.streams)
            for rule in rules
            if rule.streams is not None and rule.streams != own.streams
        ),
        "device_uses": (
            *(use for use in own.device_uses if use.agent not in ruled),
            *(use for rule in rules for use in rule.device_uses if use.agent in rule.agents),
        ),
        "place_uses": (
            *(use for use in own.place_uses if use.agent not in ruled),
            *(use for rule in rules for use in rule.place_uses if use.agent in rule.agents),
        ),
    }
