"""
Dataclasses as plain mappings, lists and scalars, and back: how what a person wrote travels to host and agents.

What a field may be is written down in `madns_runtime.plugin.parameter_kinds`; docs/plugins.md says it to people.
"""

from __future__ import annotations

import collections.abc
import copy
import dataclasses
import functools
import types
import typing
from collections.abc import Mapping, Sequence
from enum import Enum
from numbers import Integral, Real
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal, TypeGuard, TypeVar

from madns_runtime.errors import ConfigurationError

T = TypeVar("T")
CLASSES_KEPT = 256
"""Of how many dataclasses the types are kept: to evaluate them takes longer than to build a small object."""
MAPPINGS = (dict, Mapping, collections.abc.MutableMapping)
ATOMS = (str, int, float, bool, bytes, type(None))
"""Types of values that no copy makes anew."""
FORBID_EXTRA = {"extra": "forbid"}
"""Of a dataclass that a file is read into, as its `__pydantic_config__`: keys that it does not know are refused."""
LINE_CHARACTERS_MAX = 200
"""Of a name or a unit that somebody declares."""
SHOWN_CHARACTERS_MAX = 100
"""Of a value in a message."""


def to_mapping(value: Any) -> dict[str, Any]:
    """Return a dataclass, or a mapping of such, as plain mappings, lists and scalars."""
    return typing.cast("dict[str, Any]", _plain(value))


def mapping_at(mapping: Mapping[str, Any] | None, *keys: str) -> Mapping[str, Any]:
    """Return the mapping under nested keys; an empty one if any is missing or something else."""
    value: Any = mapping
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value if isinstance(value, Mapping) else {}


def is_nested_deeper(value: object, levels: int) -> bool:
    """Tell whether lists and mappings of a JSON value lie in each other on more than *levels* levels."""
    layer: list[Any] = [value] if isinstance(value, (dict, list)) else []
    for _ in range(levels):
        inner = (each.values() if isinstance(each, dict) else each for each in layer)
        layer = [item for items in inner for item in items if isinstance(item, (dict, list))]
        if not layer:
            return False
    return bool(layer)


def written_name(cls: type, field: str) -> str:
    """
    Return the key of a dataclass's field.

    It is its name, as in `lambda_` of a plug-in's parameters; a class that has one by a word which Python keeps for
    itself tells it in `__written_names__`, such as while_ to while.
    """
    names: Mapping[str, str] = getattr(cls, "__written_names__", {})
    return names.get(field, field)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [each.name for each in dataclasses.fields(value) if each.init]
        return {written_name(type(value), name): _plain(getattr(value, name)) for name in fields}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Enum):
        return _plain(value.value)
    if isinstance(value, PurePath):
        return str(value)
    return value


def from_mapping(cls: type[T], mapping: Mapping[str, Any], where: str = "") -> T:
    """
    Build a dataclass from plain mappings, as the peer's `to_mapping` wrote them.

    Checks names, presence and plain types, not bounds: those were checked where the file was read.
    A dataclass whose keys were named otherwise tells them in `__old_keys__` (old to new), and is read from either.

    Raises:
        ConfigurationError: A key is unknown or missing, or a value has another type; the message
            gives the dotted path.
    """
    value = _build(cls, mapping, where or cls.__name__)
    return typing.cast("T", value)


def _build(expected: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(expected)
    if origin is Annotated:
        return _build(typing.get_args(expected)[0], value, where)
    if dataclasses.is_dataclass(expected):
        return _build_dataclass(typing.cast("type", expected), value, where)
    if origin in (typing.Union, types.UnionType):
        return _build_union(expected, value, where)
    if origin is Literal:
        return _build_literal(typing.get_args(expected), value, where)
    if (origin or expected) in (tuple, list):
        return _build_list(expected, value, where)
    if (origin or expected) in MAPPINGS:
        return _build_mapping(expected, value, where)
    if expected is Any:
        return value
    return _build_scalar(origin or expected, value, where)


def _build_literal(options: tuple[Any, ...], value: Any, where: str) -> Any:
    for option in options:
        if type(option) is type(value) and option == value:
            return option
    raise ConfigurationError(f"{where}: expected one of {options}, got {value!r}")


def _build_list(expected: Any, value: Any, where: str) -> Any:
    if not isinstance(value, list | tuple):
        raise ConfigurationError(f"{where}: expected a list, got {value!r}")
    kind = typing.get_origin(expected) or expected
    arguments = typing.get_args(expected)
    if kind is tuple and arguments and arguments[-1] is not ...:  # tuple[float, float, float]
        if len(value) != len(arguments):
            raise ConfigurationError(f"{where}: expected {len(arguments)} items, got {len(value)}")
        items = arguments
    else:
        items = (arguments[0] if arguments else Any,) * len(value)
    pairs = zip(items, value, strict=True)
    return kind(_build(item, v, f"{where}[{i}]") for i, (item, v) in enumerate(pairs))


def _build_mapping(expected: Any, value: Any, where: str) -> Any:
    if not isinstance(value, Mapping):
        raise ConfigurationError(f"{where}: expected a mapping, got {value!r}")
    arguments = typing.get_args(expected)
    item = arguments[1] if len(arguments) > 1 else Any
    return {key: _build(item, inner, f"{where}.{key}") for key, inner in value.items()}


def _build_scalar(kind: type, value: Any, where: str) -> Any:
    if issubclass(kind, Enum):
        for member in kind:
            if type(member.value) is type(value) and member.value == value:
                return member
        known = ", ".join(str(member.value) for member in kind)
        raise ConfigurationError(f"{where}: expected one of {known}, got {value!r}")
    if issubclass(kind, PurePath) and isinstance(value, str):
        return Path(value) if kind is Path else kind(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is int):
        raise ConfigurationError(f"{where}: expected {kind.__name__}, got {value!r}")
    return value


def _build_union(expected: Any, value: Any, where: str) -> Any:
    """Build the member that is exactly of the value's type, else the first that can be built."""
    failures = []
    options = typing.get_args(expected)
    if type(value) in options:  # 3 of `float | int` is no 3.0, and "a" of `Path | str` no path
        options = (type(value), *options)
    for option in options:
        if option is type(None):
            if value is None:
                return None
            continue
        try:
            return _build(option, value, where)
        except ConfigurationError as error:
            failures.append(str(error))
    raise ConfigurationError("; or ".join(failures) or f"{where}: unexpected {value!r}")


@functools.lru_cache(maxsize=CLASSES_KEPT)
def types_of_fields(cls: type) -> Mapping[str, Any]:
    """Return the types of a dataclass's fields by name, bounds and all; whatever its annotations raise is raised."""
    return typing.get_type_hints(cls, include_extras=True)


def _build_dataclass(cls: type, value: Any, where: str) -> Any:
    if not isinstance(value, Mapping):
        raise ConfigurationError(f"{where}: expected a mapping, got {value!r}")
    old_keys: Mapping[str, str] = getattr(cls, "__old_keys__", {})
    value = {old_keys.get(key, key): item for key, item in value.items()}
    hints = types_of_fields(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    unknown = sorted(set(value) - set(fields))
    if unknown:
        raise ConfigurationError(f"{where}: unknown {', '.join(unknown)}")
    missing = [
        name
        for name, f in fields.items()
        if name not in value
        and f.default is dataclasses.MISSING
        and f.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigurationError(f"{where}: missing {', '.join(missing)}")
    return cls(**{k: _build(hints[k], v, f"{where}.{k}") for k, v in value.items()})


def is_real(value: object) -> TypeGuard[float]:
    """Tell whether a value is a real number, of Python or of NumPy; what is true or false is none."""
    if type(value) is float:
        return True
    return issubclass(type(value), Real) and type(value) is not bool


def is_whole(value: object) -> TypeGuard[int]:
    """Tell whether a value is a whole number, as `is_real`."""
    if type(value) is int:
        return True
    return issubclass(type(value), Integral) and type(value) is not bool


def are_texts(values: object) -> bool:
    """Tell whether a value is a list or a tuple of texts alone."""
    return isinstance(values, tuple | list) and all(isinstance(text, str) for text in values)


class OwnCopies:
    """Makes copies of values for many owners: what can be changed is each one's own, what cannot be is shared by all."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Any, dict[int, Any] | None]] = {}
        """By the id of a value: itself, and its parts that cannot be changed, by theirs; None if none of it can be."""

    def of(self, value: T) -> T:
        """Return a copy of a value that holds something that can be changed, such as a list; else the value itself."""
        found = self._known.get(id(value))
        if found is None:
            found = self._known[id(value)] = value, _shared_parts(value)
        if found[1] is None:
            return value
        try:
            return copy.deepcopy(value, dict(found[1]))
        except Exception:  # noqa: BLE001 - a class of a plug-in may keep what cannot be copied, such as a lock
            return value


def _shared_parts(value: Any) -> dict[int, Any] | None:
    parts: dict[int, Any] = {}
    try:
        return None if _is_fixed(value, parts) else parts
    except Exception:  # noqa: BLE001 - a plug-in's value may hold itself, or raise when it is looked at
        return {}


def _is_fixed(value: Any, parts: dict[int, Any]) -> bool:
    """Tell whether a value cannot be changed; the largest parts that cannot be of one that can are entered in *parts*."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        own = [getattr(value, each.name, None) for each in dataclasses.fields(value)]
        kind: Any = type(value)
        may_be = bool(kind.__dataclass_params__.frozen)
    elif isinstance(value, tuple | list | dict):
        own = list(value.values() if isinstance(value, dict) else value)
        may_be = isinstance(value, tuple)
    else:
        return isinstance(value, str | int | float | bytes | Enum | PurePath | None)
    are_fixed = [_is_fixed(part, parts) for part in own]
    if may_be and all(are_fixed):
        return True
    for part, is_fixed in zip(own, are_fixed, strict=True):
        if is_fixed and type(part) not in ATOMS:
            parts[id(part)] = part
    return False


def is_line(value: object) -> TypeGuard[str]:
    """Tell whether a value is one line of printable text, at most LINE_CHARACTERS_MAX long: every file can hold it."""
    return isinstance(value, str) and len(value) <= LINE_CHARACTERS_MAX and value.isprintable()


def first_few(texts: Sequence[str], most: int, separator: str = ", ") -> str:
    """Return the first of some texts in a line, and how many more there are: "a, b and 3 more", or "a; b; and 3 more"."""
    more = len(texts) - most
    ending = f"{separator.replace(', ', ' ')}and {more} more" if more > 0 else ""
    return separator.join(texts[:most]) + ending


def shown(value: object) -> str:
    """Return a value for a message; whole numbers of thousands of digits have no text, and a class may refuse one."""
    try:
        return f"{value!r:.{SHOWN_CHARACTERS_MAX}}"
    except BaseException:  # noqa: BLE001 - __repr__ of a plug-in's class may raise anything
        return f"a {type(value).__name__} that cannot be shown"
