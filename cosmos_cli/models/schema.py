"""The JSON Schema of a scenario, with the parameters of every registered simulation: for editors' completion."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter

from cosmos_cli.models.docstrings import DescribedSchema
from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.scenario import Scenario

DIALECT = "https://json-schema.org/draft/2020-12/schema"
FILE_PATTERN = ":[A-Za-z_][A-Za-z_0-9]*$"


class _Untitled(DescribedSchema):
    """Without titles that only repeat the field's name."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def scenario_schema(parameters: Mapping[str, type]) -> dict[str, Any]:
    """
    Return the JSON Schema of a scenario.

    Args:
        parameters: The parameters class of each registered simulation, by its name.
    """
    inputs: list[tuple[str, Any, TypeAdapter[Any]]] = [
        ("", "validation", TypeAdapter(Scenario)),
        *((name, "validation", adapter_of(kind)) for name, kind in sorted(parameters.items())),
    ]
    places, shared = TypeAdapter.json_schemas(inputs, schema_generator=_Untitled)
    definitions = shared["$defs"]
    root = definitions.pop(_definition_of(places[("", "validation")]))
    root["properties"]["simulation"] = {
        "description": root["properties"]["simulation"]["description"],
        "anyOf": [{"enum": sorted(parameters)}, {"type": "string", "pattern": FILE_PATTERN}],
    }
    choices = [
        _choice(name, places[(name, "validation")], definitions) for name in sorted(parameters)
    ]
    return {"$schema": DIALECT, **root, "allOf": choices, "$defs": definitions}


def schema_text(parameters: Mapping[str, type]) -> str:
    """Return the schema as it is kept in a file."""
    return json.dumps(scenario_schema(parameters), indent=2, sort_keys=True) + "\n"


def _definition_of(place: Mapping[str, Any]) -> str:
    return str(place["$ref"]).rpartition("/")[2]


def _choice(name: str, place: Mapping[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rule that this simulation's parameters are its own."""
    then: dict[str, Any] = {"properties": {"parameters": place}}
    if definitions[_definition_of(place)].get("required"):
        then["required"] = ["parameters"]
    return {"if": {"properties": {"simulation": {"const": name}}}, "then": then}
