"""The tables of docs/scenarios.md: every key of a scenario, from the JSON Schema, which comes from the code."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.models.scenario import Scenario
from cosmos_cli.models.variables import VARIABLE

SCHEMA = Path(__file__).parents[1] / "scenarios" / "scenario.schema.json"
BEGIN = "<!-- Generated from here on by `python docs/generate.py`; edit the docstrings of the fields. -->\n"
_BOUNDS = (
    ("minimum", ">= "),
    ("exclusiveMinimum", "> "),
    ("maximum", "<= "),
    ("exclusiveMaximum", "< "),
    ("minItems", "items >= "),
    ("maxItems", "items <= "),
)
_WORDS = {
    "array": "list",
    "boolean": "true or false",
    "integer": "whole number",
    "null": "nothing",
    "object": "mapping",
    "string": "text",
}


def with_fields(page: str) -> str:
    """Return a page with its generated part as the code has it."""
    head, _, _ = page.partition(BEGIN)
    return head + BEGIN + "".join(_tables(json.loads(SCHEMA.read_text("utf-8"))))


def _tables(schema: Mapping[str, Any]) -> Iterator[str]:
    definitions, told = schema["$defs"], set[str]()
    yield "\n## All keys\n\n"
    yield from _table(
        {key: schema["properties"][key] for key in Scenario.model_fields},
        schema["allOf"][0]["else"]["required"],
    )
    for key in Scenario.model_fields:
        yield from _below(schema["properties"][key], definitions, told)
    yield "\n### Actions of a timeline\n\n"
    yield from _actions(schema["properties"]["timeline"]["items"], schema["$defs"]["TimelineRule"])
    for name, parameters in sorted(_simulations(schema)):
        yield f"\n## Parameters of {name}\n"
        yield from _below(parameters, definitions, told)


def _simulations(schema: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the names of simulations and the schemas of their parameters."""
    for each in schema["allOf"]:
        named = each["if"].get("properties", {}).get("simulation")
        if named is not None:
            yield named["const"], each["then"]["properties"]["parameters"]


def _below(schema: Any, definitions: Mapping[str, Any], told: set[str]) -> Iterator[str]:
    """Yield the tables of all that a schema refers to and that stands nowhere above."""
    for name in _referred(schema):
        if name in told:
            continue
        told.add(name)
        found = definitions[name]
        yield f"\n### {name}\n\n{_line(found.get('description', ''))}\n\n"
        yield from _table(found.get("properties", {}), found.get("required", ()))
        yield from _below(found.get("properties", {}), definitions, told)


def _actions(entry: Mapping[str, Any], rule: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of the framework's actions; a simulation's own are on the page of timelines."""
    beside = {each["if"]["properties"]["action"]["const"]: each["then"] for each in entry["allOf"]}
    yield "| action | beside it | |\n|---|---|---|\n"
    for word in rule["properties"]["action"]["anyOf"]:
        if "const" in word:
            then = beside[word["const"]]
            names = list(dict.fromkeys((*then.get("required", ()), *then.get("properties", ()))))
            yield f"| {word['const']} | {', '.join(names)} | {_line(word['description'])} |\n"


def _referred(schema: Any) -> Iterator[str]:
    if isinstance(schema, list):
        for item in schema:
            yield from _referred(item)
    elif isinstance(schema, dict):
        if "$ref" in schema:
            yield schema["$ref"].rpartition("/")[2]
        for key, item in schema.items():
            if key != "discriminator":
                yield from _referred(item)


def _table(properties: Mapping[str, Any], required: Any) -> Iterator[str]:
    yield "| key | value | default | |\n|---|---|---|---|\n"
    for name, field in properties.items():
        default = "must be given" if name in required else _default(field)
        text = _line(field.get("description", ""))
        yield f"| {name} | {_cell(_kind(field))} | {_cell(default)} | {text} |\n"


def _default(field: Mapping[str, Any]) -> str:
    if "default" not in field:
        return ""
    text = json.dumps(field["default"])
    return "nothing" if text == "null" else text if len(text) <= 40 else "see there"


def _kind(schema: Mapping[str, Any]) -> str:
    """Return what a value may be, with its bounds."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(
                dict.fromkeys(
                    _kind(each)
                    for each in schema[key]
                    if (each.get("type"), each.get("pattern")) != ("string", VARIABLE)
                )
            )
    if "enum" in schema or "const" in schema:
        return " or ".join(json.dumps(each) for each in schema.get("enum", [schema.get("const")]))
    kinds = schema.get("type", "any")
    kind = kinds[0] if isinstance(kinds, list) else kinds
    words = _WORDS.get(kind, kind)
    if kind == "array" and (items := schema.get("items")):
        words = f"list of {_kind(items)}"
    bounds = [f"{sign}{schema[key]:g}" for key, sign in _BOUNDS if key in schema]
    return ", ".join([words, *bounds])


def _line(text: str) -> str:
    return _cell(" ".join(text.split()))


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("${", "\\${")
