"""The part of a scenario's JSON Schema that knows its timeline: words of actions, and the parameters beside each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import TypeAdapter

from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.timeline_rules import TimelineRule
from cosmos_cli.models.variables import VARIABLE
from madns_runtime.timeline.action import ActionKind, NoParameters
from madns_runtime.timeline.kinds import FRAMEWORK_ACTIONS

ENTRY = "timeline"
Inputs = list[tuple[str, Any, TypeAdapter[Any]]]


def timeline_inputs(actions: Mapping[str, Iterable[ActionKind]]) -> Inputs:
    """Return what pydantic is to describe: an entry, and the parameters of each action, by names of their own."""
    kinds = [("", FRAMEWORK_ACTIONS), *sorted(actions.items())]
    return [
        (ENTRY, "validation", TypeAdapter(TimelineRule)),
        *(
            (_name(owner, kind), "validation", adapter_of(kind.parameters))
            for owner, own in kinds
            for kind in own
            if kind.parameters is not NoParameters
        ),
    ]


def entry_schema(
    places: Mapping[tuple[str, Any], Mapping[str, Any]],
    definitions: dict[str, dict[str, Any]],
    owner: str = "",
    actions: Iterable[ActionKind] = (),
) -> dict[str, Any]:
    """
    Return the schema of one entry.

    Args:
        places: Where pydantic put what `timeline_inputs` asked for.
        definitions: The schema's; those of parameters are taken, since theirs are not an entry's only keys.
        owner: A simulation, whose words join the framework's; empty for these alone.
        actions: Its own.
    """
    kinds = tuple(actions) if owner else FRAMEWORK_ACTIONS
    rules = [_rule(kind, places, definitions, owner) for kind in kinds]
    words = [
        {"const": kind.word, "description": kind.summary}
        for kind in dict.fromkeys((*FRAMEWORK_ACTIONS, *kinds))
    ]
    if owner:
        own = {
            "properties": {"action": {"anyOf": [*words, {"type": "string", "pattern": VARIABLE}]}}
        }
        return {**own, "allOf": rules} if rules else own
    place = places[ENTRY, "validation"]
    entry = definitions[str(place["$ref"]).rpartition("/")[2]]
    entry.pop("additionalProperties", None)
    # Of a simulation that nobody registered, any word may be one.
    entry["properties"]["action"]["anyOf"] = [*words, {"type": "string"}]
    return {**place, "allOf": rules}


def _rule(
    kind: ActionKind,
    places: Mapping[tuple[str, Any], Mapping[str, Any]],
    definitions: dict[str, dict[str, Any]],
    owner: str,
) -> dict[str, Any]:
    """Return what stands beside the word of an action."""
    required = ["agents"] if kind.takes_agents else []
    if kind.lasting == "must":
        required.append("for_s")
    then: dict[str, Any] = {}
    if kind.parameters is not NoParameters:
        place = places[_name(owner, kind), "validation"]
        found = definitions.pop(str(place["$ref"]).rpartition("/")[2])
        then["properties"] = found["properties"]
        required += found.get("required", [])
    if required:
        then["required"] = required
    return {
        "if": {"required": ["action"], "properties": {"action": {"const": kind.word}}},
        "then": then,
    }


def _name(owner: str, kind: ActionKind) -> str:
    return f"{owner} {kind.word}"
