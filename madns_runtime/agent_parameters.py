"""Parameters of a simulation that hold for some of a run's agents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import MinLen


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentParameters:
    """Parameters of the simulation for some of the agents; the first of several that names an agent holds for it."""

    __pydantic_config__ = {"extra": "forbid"}

    agents: Annotated[tuple[str, ...], MinLen(1)]
    """Names of agents, or globs such as sat-0*; second names do as well."""
    parameters: Mapping[str, Any]
    """Differences from the scenario's parameters: mappings merge, lists and scalars replace."""
