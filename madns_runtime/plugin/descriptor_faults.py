"""Faults in a simulation's descriptor itself, before any part of it is imported, in words. Pure."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, Final

from madns_runtime.plain_values import LINE_CHARACTERS_MAX, are_texts, is_line, shown
from madns_runtime.plugin.columns import shape_faults
from madns_runtime.plugin.kept_names import name_faults
from madns_runtime.plugin.parameter_kinds import kind_faults
from madns_runtime.timeline.kinds import ENTRY_KEYS, kind_texts

COLUMNS_OF_TABLES: Final = ("agent", "agent_name", "host", "incarnation", "t_s", "simulated_utc")
"""Columns that tables add to records: second names need one of their own."""


def descriptor_faults(descriptor: Any) -> Iterator[str]:
    """Yield a fault per field that is not what it must be, but for those that name parts."""
    parameters = descriptor.parameters
    if not (isinstance(parameters, type) and dataclasses.is_dataclass(parameters)):
        yield "parameters: expected a dataclass (the class itself)"
    for field in ("name", "label_column"):
        value = getattr(descriptor, field)
        if not is_line(value) or not value:
            yield (
                f"{field}: expected a text of at most {LINE_CHARACTERS_MAX} printable characters, got {shown(value)}"
            )
        elif field == "name":
            yield from name_faults(value)
        elif value in COLUMNS_OF_TABLES:
            yield f"label_column: tables have a column {value!r} already; choose another name"
    yield from shape_faults(descriptor.columns)
    own = descriptor.agent_parameters
    if own is not None and not are_texts(own):
        yield f"agent_parameters: expected a tuple of parameters' names, or None, got {shown(own)}"
    elif own and dataclasses.is_dataclass(parameters):
        known = {field.name for field in dataclasses.fields(parameters)}
        if unknown := [name for name in own if name not in known]:
            yield f"agent_parameters: there is no parameter {', '.join(map(shown, unknown))}"
    words = descriptor.placeholders
    if not isinstance(words, Mapping) or not all(
        isinstance(field, str) and are_texts(own) for field, own in words.items()
    ):
        yield (
            "placeholders: expected a mapping of parameters' names to tuples of words, got"
            f" {shown(words)}"
        )
    actions = descriptor.actions
    if not isinstance(actions, tuple | list):
        yield f"actions: expected a tuple of ActionKind, got {shown(actions)}"
        return
    yield from (f"actions: {text}" for text in kind_texts(actions))
    yield from (f"actions: {text}" for each in actions for text in _parameter_texts(each))


def _parameter_texts(action: Any) -> list[str]:
    """Return what is wrong with the parameters of a declared action."""
    kind: Any = getattr(action, "parameters", None)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        return [
            f"{getattr(action, 'word', shown(action))}.parameters: expected a dataclass (the class)"
        ]
    texts = [
        f"{field.name}: no parameter can be called so, for an entry of a timeline has that key itself"
        for field in dataclasses.fields(kind)
        if field.name in ENTRY_KEYS
    ]
    return [f"{action.word}.parameters: {text}" for text in (*texts, *kind_faults(kind))]
