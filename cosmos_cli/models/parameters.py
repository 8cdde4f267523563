"""
A simulation's parameters class, validated as strictly as the scenario itself.

Pydantic ignores unknown keys of a plain dataclass. A plug-in's author should not have to know that,
so a class that says nothing about it is told to refuse them.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from typing import Any

from pydantic import TypeAdapter

from madns_runtime.errors import PluginError
from madns_runtime.plain_values import CLASSES_KEPT, FORBID_EXTRA, types_of_fields
from madns_runtime.plugin.code_places import place_of
from madns_runtime.plugin.parameter_kinds import kind_faults

_CONFIG = "__pydantic_config__"


@functools.lru_cache(maxsize=CLASSES_KEPT)
def adapter_of(parameters: type) -> TypeAdapter[Any]:
    """
    Return the validator of a parameters class; kept, for making a large one takes a fifth of what `validate` does.

    Raises:
        PluginError: A field's type is none that a scenario can hold.
    """
    faults = kind_faults(parameters)
    if faults:
        raise PluginError(f"{place_of(parameters)}: {'; '.join(faults)}; see docs/plugins.md")
    _forbid_extra(parameters, set())
    return TypeAdapter(parameters)


def _forbid_extra(kind: Any, seen: set[Any]) -> None:
    for argument in typing.get_args(kind):
        _forbid_extra(argument, seen)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)) or kind in seen:
        return
    seen.add(kind)
    if _CONFIG not in vars(kind):
        setattr(kind, _CONFIG, FORBID_EXTRA)
    for hint in types_of_fields(kind).values():
        _forbid_extra(hint, seen)
