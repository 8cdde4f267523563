"""The part of a scenario's JSON Schema that knows its timeline: words of actions, and the parameters beside each."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import TypeAdapter

from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.timeline_rules import TimelineRule
from cosmos_cli.models.variables import VARIABLE
from madns_runtime.timeline.action import ActionKind, NoParameters
from madns_runtime.timeline.kinds import FRAMEWORK_ACTIONS

ENTRY = "timeline"
Places = Mapping[tuple[str, Any], Mapping[str, Any]]
Definitions = dict[str, dict[str, Any]]
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


def entry_schema(places: Places, definitions: Definitions) -> dict[str, Any]:
    """
    Return the schema of an entry, with the framework's actions: of a simulation that nobody registered any word may be one.

    Args:
        places: Where pydantic put what `timeline_inputs` asked for.
        definitions: The schema's.
    """
    place = places[ENTRY, "validation"]
    entry = definitions[str(place["$ref"]).rpartition("/")[2]]
    entry.pop("additionalProperties", None)
    entry["properties"]["action"]["anyOf"] = [*_words(FRAMEWORK_ACTIONS), {"type": "string"}]
    rules = [_rule(kind, places, definitions) for kind in FRAMEWORK_ACTIONS]
    return {**place, "allOf": rules}


def own_entry_schema(
    places: Places, definitions: Definitions, owner: str, actions: Sequence[ActionKind]
) -> dict[str, Any]:
    """Return what holds of an entry besides where *owner* is the simulation: its actions join the framework's."""
    known = [*_words(FRAMEWORK_ACTIONS), *_words(actions), {"type": "string", "pattern": VARIABLE}]
    rules = [_rule(kind, places, definitions, owner) for kind in actions]
    return {"properties": {"action": {"anyOf": known}}, **({"allOf": rules} if rules else {})}


def drop_action_definitions(
    schema: Mapping[str, Any], inputs: Inputs, places: Places, definitions: Definitions
) -> None:
    """
    Drop the definitions of actions' parameters to which nothing in *schema* refers: their rules hold copies.

    Args:
        schema: With *definitions* in it.
        inputs: As of `timeline_inputs`.
        places: Where pydantic put them.
        definitions: The schema's.
    """
    text = json.dumps(schema)
    for name, mode, _ in inputs:
        definition = str(places[name, mode]["$ref"])
        if name != ENTRY and json.dumps(definition) not in text:
            definitions.pop(definition.rpartition("/")[2], None)


def _words(kinds: Iterable[ActionKind]) -> list[dict[str, Any]]:
    return [{"const": kind.word, "description": kind.summary} for kind in kinds]


def _rule(
    kind: ActionKind,
    places: Places,
    definitions: Definitions,
    owner: str = "",
) -> dict[str, Any]:
    """Return what stands beside the word of an action."""
    required = ["agents"] if kind.takes_agents else []
    if kind.lasting == "must":
        required.append("for_s")
    then: dict[str, Any] = {}
    if kind.parameters is not NoParameters:
        place = places[_name(owner, kind), "validation"]
        # A copy: several actions may have one class, and a simulation's parameters may hold it as well.
        found = copy.deepcopy(definitions[str(place["$ref"]).rpartition("/")[2]])
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
