"""
The JSON Schema of a scenario, with the parameters of every registered simulation: for editors' completion.

Its descriptions are the docstrings of fields. pydantic can take them along itself, but then every command that reads
a scenario parses our sources first.
"""

from __future__ import annotations

import ast
import functools
import inspect
import json
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.scenario import Scenario
from cosmos_cli.models.timeline_schema import (
    drop_action_definitions,
    entry_schema,
    own_entry_schema,
    timeline_inputs,
)
from cosmos_cli.models.variables import VARIABLE
from madns_runtime.plugin.api import Simulation

DIALECT = "https://json-schema.org/draft/2020-12/schema"
FILE_PATTERN = ":[A-Za-z_][A-Za-z_0-9]*$"


@functools.lru_cache(maxsize=256)
def field_docstrings(cls: type) -> dict[str, str]:
    """Return the texts under a class's annotated fields, by the fields' names; its own come before its bases'."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base is not object and base.__dict__.get("__annotations__"):
            found.update(_own(base))
    return found


def _own(cls: type) -> dict[str, str]:
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError):  # made without a source
        return {}
    statements = body.body if isinstance(body, ast.ClassDef) else []
    found = {}
    for statement, following in zip(statements, statements[1:], strict=False):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            match following:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    found[statement.target.id] = inspect.cleandoc(text)
                case _:
                    pass
    return found


class _DescribedSchema(GenerateJsonSchema):
    """Schemas whose properties say what their fields' docstrings say, without titles that only repeat their names."""

    def model_schema(self, schema: Any) -> JsonSchemaValue:
        return _described(super().model_schema(schema), schema["cls"])

    def dataclass_schema(self, schema: Any) -> JsonSchemaValue:
        return _described(super().dataclass_schema(schema), schema["cls"])

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def _described(json_schema: JsonSchemaValue, cls: type) -> JsonSchemaValue:
    texts = field_docstrings(cls)
    for name, field in json_schema.get("properties", {}).items():
        if name in texts:
            field.setdefault("description", texts[name])
    return json_schema


def scenario_schema(simulations: Mapping[str, Simulation]) -> dict[str, Any]:
    """
    Return the JSON Schema of a scenario.

    Args:
        simulations: Those that are registered, by their names.
    """
    known = sorted(simulations.items())
    actions = {name: simulation.actions for name, simulation in known}
    of_timeline = timeline_inputs(actions)
    inputs: list[tuple[str, Any, TypeAdapter[Any]]] = [
        ("", "validation", TypeAdapter(Scenario)),
        *((name, "validation", adapter_of(each.parameters)) for name, each in known),
        *of_timeline,
    ]
    places, shared = TypeAdapter.json_schemas(inputs, schema_generator=_DescribedSchema)
    definitions = shared["$defs"]
    root = definitions.pop(_definition_of(places["", "validation"]))
    root["properties"]["simulation"] = {
        "description": root["properties"]["simulation"]["description"],
        "anyOf": [{"enum": sorted(simulations)}, {"type": "string", "pattern": FILE_PATTERN}],
    }
    root["properties"]["timeline"]["items"] = entry_schema(places, definitions)
    whole = _taken_requirements(root, definitions)
    entries = {
        name: own_entry_schema(places, definitions, name, own) for name, own in actions.items()
    }
    of_parameters = {
        name: definitions[_definition_of(places[name, "validation"])] for name in actions
    }
    # Simulations may have one class of parameters: what it requires is taken when all have read it.
    required = {name: each.get("required", []) for name, each in of_parameters.items()}
    for each in of_parameters.values():
        each.pop("required", None)
    choices = [
        _choice(name, places[name, "validation"], required[name], entries[name]) for name in actions
    ]
    found = {**root, "allOf": [whole, *choices], "$defs": definitions}
    drop_action_definitions(found, of_timeline, places, definitions)
    _let_variables_stand(found)
    return {"$schema": DIALECT, **found}


def schema_text(simulations: Mapping[str, Simulation]) -> str:
    """Return the schema as it is kept in a file."""
    return json.dumps(scenario_schema(simulations), indent=2, sort_keys=True) + "\n"


def _definition_of(place: Mapping[str, Any]) -> str:
    return str(place["$ref"]).rpartition("/")[2]


def _taken_requirements(
    root: dict[str, Any], definitions: Mapping[str, dict[str, Any]]
) -> dict[str, Any]:
    """Return the rule that keys must be there, of the scenario and its sections, unless it extends another."""
    sections = {}
    for name, section in root["properties"].items():
        if "$ref" in section and (
            required := definitions[_definition_of(section)].pop("required", None)
        ):
            sections[name] = {"required": required}
    whole = {"required": root.pop("required"), "properties": sections}
    return {"if": {"required": ["extends"]}, "then": {}, "else": whole}


def _let_variables_stand(schema: Any) -> None:
    """Let ${name} stand, below *schema*, for each number, list, choice, and text with a pattern."""
    if isinstance(schema, list):
        for item in schema:
            _let_variables_stand(item)
    if not isinstance(schema, dict):
        return
    for key, item in schema.items():
        if key != "if":  # which tells simulations apart, not what may be written
            _let_variables_stand(item)
    kind = schema.get("type")
    if kind in ("integer", "number", "boolean", "array"):
        schema |= {"type": [kind, "string"], "pattern": VARIABLE}
    elif kind == "string" and isinstance(schema.get("enum"), list):
        found = {key: schema.pop(key) for key in ("type", "enum")}
        schema["anyOf"] = [found, {"type": "string", "pattern": VARIABLE}]
    elif kind == "string" and schema.get("pattern", VARIABLE) != VARIABLE:
        schema["pattern"] = f"(?:{schema['pattern']})|{VARIABLE}"


def _choice(
    name: str,
    place: Mapping[str, Any],
    required: Sequence[str],
    entry: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the rule that this simulation's parameters and its actions are its own."""
    then: dict[str, Any] = {
        "properties": {
            "parameters": place,
            "agent_parameters": {"items": {"properties": {"parameters": place}}},
            "timeline": {"items": entry},
        }
    }
    if required:
        whole = {"required": ["parameters"], "properties": {"parameters": {"required": required}}}
        then |= {"if": {"required": ["extends"]}, "then": {}, "else": whole}
    # What a base names is not known here: then no simulation's rule holds.
    named = {"required": ["simulation"], "properties": {"simulation": {"const": name}}}
    return {"if": named, "then": then}
