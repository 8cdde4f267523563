"""Places of one machine that several agents would take, although only one of them can have it. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from cosmos_cli.models.device_uses import named_agents
from madns_runtime.plugin.api import PlaceUse


def shared_places(uses: Sequence[PlaceUse], agents: Iterable[str]) -> list[tuple[str, str]]:
    """
    Return the parameter and the words about each place that more than one of some agents would take.

    Args:
        uses: By the simulation's parameters.
        agents: Those of one machine.
    """
    here = frozenset(agents)
    users: dict[str, dict[str, str]] = {}
    for use in uses:
        if use.agent in here:
            users.setdefault(use.place, {})[use.agent] = use.field
    return [
        (field, f"{place}: {named_agents(tuple(fields))} cannot have it at once on one machine")
        for place, fields in users.items()
        if len(fields) > 1
        for field in dict.fromkeys(fields.values())
    ]


CURE = "${name} or ${index} in it tells them apart; so do machines of their own"
"""Of what the parameters of agents have in common."""
