"""What kernels did not grant to agents although it was asked for by name: remarks of the verdict. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cosmos_cli.expectation import mapping_at
from cosmos_cli.fleet.names import compact


def affinity_remarks(agents: Mapping[str, Any]) -> tuple[str, ...]:
    """
    Return a remark for each reason for which processors were refused, with the agents that it was so for.

    Args:
        agents: What the host's result holds of each agent.
    """
    refused: dict[str, list[str]] = {}
    for name in agents:
        refusal = mapping_at(agents, name, "scheduling").get("cpu_affinity_refusal")
        if isinstance(refusal, str):
            refused.setdefault(refusal, []).append(name)
    return tuple(
        f"{compact(names)}: scheduling.cpu_affinity: {refusal}"
        for refusal, names in refused.items()
    )
