"""Places of one machine that several agents would take, although only one of them can have it. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from cosmos_cli.models.device_uses import named_agents
from cosmos_cli.models.fault_place import path_named
from cosmos_cli.models.variables import words_at
from madns_runtime.plugin.api import PlaceUse

WORDS_NAMED_MAX: Final = 2


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


def cure_of(
    field: str, placeholders: Mapping[str, tuple[str, ...]], *, has_machines: bool = True
) -> str:
    """
    Return what tells apart the places that a parameter gives several agents.

    Args:
        field: Dotted name of the parameter.
        placeholders: Words that the simulation replaces per agent, by field.
        has_machines: Whether agents may run on machines of their own.
    """
    words = words_at(path_named(field), placeholders)[:WORDS_NAMED_MAX]
    own = "agent_parameters, where the simulation lets it differ, tells them apart"
    if words:
        own = f"{' or '.join(f'${{{word}}}' for word in words)} in it tells them apart"
    return f"{own}; so do machines of their own" if has_machines else own
