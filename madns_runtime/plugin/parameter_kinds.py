"""
Kinds of parameters: all that YAML can say, that travels to every board, and that comes out the same.

Standard library alone, for both sides; docs/plugins.md lists the kinds for people.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import types
import typing
from collections.abc import Iterator
from enum import Enum, Flag
from pathlib import Path, PurePath
from typing import Annotated, Any, Final, Literal

from madns_runtime.plain_values import types_of_fields
from madns_runtime.plugin.isolation import said

SCALARS: Final = (bool, int, float, str)
PATHS: Final = (Path, PurePath)
LISTS: Final = (tuple, list)
MAPPINGS: Final = (dict, collections.abc.Mapping)
EXPECTED: Final = (
    "bool, int, float, str, Path, Literal, an Enum of texts or numbers, a dataclass of these,"
    " tuple, list, dict[str, ...], or a union of these with or without None"
)


def kind_faults(parameters: type) -> list[str]:
    """Return each field of a parameters class, or of a dataclass within, that no scenario can hold."""
    return list(_class_faults(parameters, parameters.__name__, set()))


def _class_faults(cls: type, where: str, seen: set[type]) -> Iterator[str]:
    if cls in seen:
        return
    seen.add(cls)
    try:
        hints = types_of_fields(cls)
    except Exception as error:  # noqa: BLE001 - annotations are evaluated, and may raise anything
        yield f"{where}: its annotations cannot be read: {said(error)}"
        return
    for field in dataclasses.fields(cls):
        if field.init:
            yield from _faults(hints[field.name], f"{where}.{field.name}", seen)


def _faults(kind: Any, where: str, seen: set[type]) -> Iterator[str]:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        yield from _faults(arguments[0], where, seen)
    elif origin in (typing.Union, types.UnionType):
        for argument in arguments:
            if argument is not type(None):
                yield from _faults(argument, where, seen)
    elif origin is Literal:
        if not all(argument is None or type(argument) in SCALARS for argument in arguments):
            yield _fault(where, kind)
    elif (origin or kind) in LISTS:
        for argument in arguments:
            if argument is not ...:
                yield from _faults(argument, f"{where}[]", seen)
    elif (origin or kind) in MAPPINGS:
        yield from _mapping_faults(kind, arguments, where, seen)
    elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
        yield from _class_faults(kind, f"{where} ({kind.__name__})", seen)
    elif not _is_plain(kind):
        yield _fault(where, kind)


def _mapping_faults(
    kind: Any, arguments: tuple[Any, ...], where: str, seen: set[type]
) -> Iterator[str]:
    if arguments and arguments[0] is not str:
        yield f"{where}: expected texts as keys, got {_name(kind)}"
    for argument in arguments[1:]:
        yield from _faults(argument, f"{where}[]", seen)


def _is_plain(kind: Any) -> bool:
    if kind is Any or kind in SCALARS or kind in PATHS:
        return True
    if not (isinstance(kind, type) and issubclass(kind, Enum)) or issubclass(kind, Flag):
        return False
    return all(type(member.value) in SCALARS for member in kind)


def _fault(where: str, kind: Any) -> str:
    return f"{where}: expected {EXPECTED}; got {_name(kind)}"


def _name(kind: Any) -> str:
    if isinstance(kind, type) and not typing.get_args(kind):
        is_builtin = kind.__module__ == "builtins"
        return kind.__qualname__ if is_builtin else f"{kind.__module__}.{kind.__qualname__}"
    return str(kind)
