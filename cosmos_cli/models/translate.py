"""Pydantic's errors as faults in the person's terms: where, what was expected, what came."""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Union

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault
from cosmos_cli.models.document import Document, Path, did_you_mean, kind_of
from cosmos_cli.models.text_forms import NAME_PATTERN
from madns_runtime.plain_values import written_name

_EXPECTED = {
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "dataclass_type": "a mapping",
    "dict_type": "a mapping",
    "float_parsing": "a number",
    "float_type": "a number",
    "frozen_set_type": "a list",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "int_type": "a whole number",
    "list_type": "a list",
    "mapping_type": "a mapping",
    "model_type": "a mapping",
    "none_required": "nothing",
    "path_type": "a path",
    "set_type": "a list",
    "string_type": "a text",
    "tuple_type": "a list",
}
ALTERNATIVES = "alternatives"
"""Type of an error that is made of those of a union's members."""
_LIMITS = {
    "greater_than": ("> ", "gt"),
    "greater_than_equal": (">= ", "ge"),
    "less_than": ("< ", "lt"),
    "less_than_equal": ("<= ", "le"),
    "multiple_of": ("a multiple of ", "multiple_of"),
    "literal_error": ("", "expected"),
    "enum": ("", "expected"),
    "string_pattern_mismatch": ("a text like ", "pattern"),
    "union_tag_invalid": ("", "expected_tags"),
}
_LENGTHS = {
    "string_too_short": ("at least", "min_length", "characters"),
    "too_short": ("at least", "min_length", "items"),
    "string_too_long": ("at most", "max_length", "characters"),
    "too_long": ("at most", "max_length", "items"),
}
HINTS_MAX = 2 * FAULTS_SHOWN_MAX
"""Of all faults, some of which give way to others."""
_PATTERNS = {NAME_PATTERN: "lower-case letters, digits and hyphens"}
_MISSING = ("missing", "missing_argument", "missing_keyword_only_argument")
_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_UNSEEN = re.compile("[\xa0\xad\u2000-\u200f\u202f\u205f\u2060\u3000\ufeff]")
"""Spaces of other kinds, and what has no width: pages and word processors bring them along."""


@dataclasses.dataclass(frozen=True, slots=True)
class Located:
    """One error of pydantic at its place in the document."""

    path: Path
    """Only steps that are in the document, but for a missing key."""
    branches: tuple[Path, ...]
    """Entries into unions, the outermost first, each with the label of its member; empty outside of unions."""
    error: Mapping[str, Any]

    @property
    def branch(self) -> Path:
        """The innermost of them; empty outside of unions."""
        return self.branches[-1] if self.branches else ()

    @property
    def member(self) -> str:
        """The label of the union's member; empty outside of unions."""
        return str(self.branch[-1]) if self.branch else ""


def faults_of(
    document: Document, errors: Sequence[Any], model: Any, *, below: Path = ()
) -> list[Fault]:
    """
    Return pydantic's errors as faults.

    Args:
        document: Where the validated value came from.
        errors: Of `ValidationError.errors()`.
        model: The type that was validated; tells what keys are known.
        below: Path of the validated value within the document.
    """
    located = [
        _located(document, below, error) for error in errors if not _misses_invalid_items(error)
    ]
    return [
        # To guess what was meant takes a thousand times as long as to tell what is wrong.
        _fault(document, item, (model, below), has_hints=number < HINTS_MAX)
        for number, item in enumerate(_likeliest(located))
    ]


def _misses_invalid_items(error: Mapping[str, Any]) -> bool:
    """Tell whether a list is too short only because pydantic does not count the items that are invalid themselves."""
    if error["type"] != "too_short" or not isinstance(error["input"], list):
        return False
    return len(error["input"]) >= int(error["ctx"]["min_length"])


def _located(document: Document, below: Path, error: Mapping[str, Any]) -> Located:
    """Follow pydantic's location through the values; labels of union members are no keys."""
    value = _value_at(document, below)
    path = below
    branches: list[Path] = []
    steps = list(error["loc"])
    for index, step in enumerate(steps):
        if _holds(value, step):
            path, value = (*path, step), value[step]
        elif error["type"] in _MISSING and index == len(steps) - 1:
            path = (*path, step)
        else:
            branches = [each for each in branches if each[:-1] != path] + [(*path, str(step))]
    return Located(path, tuple(branches), error)


def _holds(value: Any, step: str | int) -> bool:
    if isinstance(value, list):
        return isinstance(step, int) and step < len(value)
    return isinstance(value, dict) and step in value


def _value_at(document: Document, path: Path) -> Any:
    value: Any = document.value
    for step in path:
        value = value[step]
    return value


def _likeliest(located: Sequence[Located], depth: int = 0) -> Iterator[Located]:
    """Of a union's members, keep the errors of the one that was probably meant: it got furthest."""
    members: dict[Path, dict[Path, list[Located]]] = {}
    for item in located:
        if len(item.branches) <= depth:
            yield item
        else:
            branch = item.branches[depth]
            members.setdefault(branch[:-1], {}).setdefault(branch, []).append(item)
    for entry, group in members.items():
        choice = _common_choice(list(group.values()), depth)
        if choice:
            yield choice
            continue
        distances = [_distance(entry, errors) for errors in group.values()]
        nearest = min(distances)
        meant = [
            errors
            for errors, distance in zip(group.values(), distances, strict=True)
            if distance == nearest
        ]
        beside = [errors for errors in meant if _places(errors) == _places(meant[0])]
        yield from _alternatives(beside, depth) or _likeliest(meant[0], depth + 1)


def _places(errors: Sequence[Located]) -> list[Path]:
    return [item.path for item in errors]


def _alternatives(members: Sequence[Sequence[Located]], depth: int) -> list[Located]:
    """
    Return errors that name the types of all members, where values are of none of them and nothing else is wrong.

    All members have errors at the same places.
    """
    are_types = all(
        item.error["type"] in _EXPECTED and len(item.branches) == depth + 1
        for errors in members
        for item in errors
    )
    if len(members) < 2 or not are_types:
        return []
    return [
        Located(items[0].path, (), {**items[0].error, "type": ALTERNATIVES, "ctx": _types(items)})
        for items in zip(*members, strict=True)
    ]


def _types(items: Sequence[Located]) -> Mapping[str, str]:
    names = list(dict.fromkeys(_EXPECTED[item.error["type"]] for item in items))
    if "a number" in names and "a whole number" in names:
        names.remove("a whole number")
    *before, last = names
    return {"expected": f"{', '.join(before)} or {last}" if before else last}


def _common_choice(members: Sequence[Sequence[Located]], depth: int) -> Located | None:
    """Return one error for a key that every member knows and whose value none of them has, such as `kind`."""
    found = [
        [
            item
            for item in member
            if item.error["type"] == "literal_error" and len(item.branches) == depth + 1
        ]
        for member in members
    ]
    if len(members) < 2 or not all(found) or len({errors[0].path for errors in found}) > 1:
        return None
    first = found[0][0]
    options = [str(errors[0].error["ctx"]["expected"]) for errors in found]
    context = {"expected": " or ".join(dict.fromkeys(options))}
    return Located(first.path, (), {**first.error, "ctx": context})


def _distance(entry: Path, errors: Sequence[Located]) -> tuple[bool, int, int, int]:
    """
    Return how far a member is from what was written: of another type, then by its tag, then by all errors.

    Errors in a union further in say nothing here: each of its members has one. Nor do wrong keys further in, of which
    the member that is meant may have many.
    """
    is_misfit = any(item.path == entry and item.error["type"].endswith("_type") for item in errors)
    own = [item for item in errors if item.branches and item.branch[:-1] == entry]
    decisive = sum(
        item.path == entry
        or (item.error["type"] in ("literal_error", *_UNKNOWN) and len(item.path) == len(entry) + 1)
        for item in own
    )
    return is_misfit, sum(_is_tag(item, entry) for item in errors), decisive, len(errors)


def _is_tag(item: Located, entry: Path) -> bool:
    """Tell whether a key has another value than the one by which this member is told from others."""
    if item.error["type"] != "literal_error" or len(item.path) != len(entry) + 1:
        return False
    return " or " not in str(item.error["ctx"]["expected"])


def _fault(
    document: Document, item: Located, within: tuple[Any, Path], *, has_hints: bool
) -> Fault:
    kind, path = item.error["type"], item.path
    model, below = within
    context = item.error.get("ctx", {})
    if kind in _MISSING:
        about = _about(model, path[len(below) :]) if has_hints else ""
        return document.fault(path, f"missing{about}")
    if kind in _UNKNOWN:
        inner = path[len(below) : -1]
        known = known_keys(model, inner, member=item.member) if has_hints else []
        unseen = _UNSEEN.search(str(path[-1]))
        hint = did_you_mean(str(path[-1]), known)
        if unseen:
            hint = f": it holds U+{ord(unseen[0]):04X}, which looks like a space or like nothing; type the key anew"
        return document.fault(path, f"unknown key{hint}", at_key=True)
    value, written = item.error["input"], document.texts.get(path)
    got = written if written and not isinstance(value, str) else kind_of(value)
    if kind == "string_type" and value is None and written:
        got += f'; the text is written in quotes: "{written}"'  # a kind of device is called null
    return document.fault(path, _text(kind, context, item.error, got, has_hints=has_hints))


def _text(
    kind: str, context: Mapping[str, Any], error: Mapping[str, Any], got: str, *, has_hints: bool
) -> str:
    if kind in _EXPECTED or kind == ALTERNATIVES:
        return f"expected {_EXPECTED.get(kind) or context['expected']}, got {got}"
    if kind == "string_pattern_mismatch" and context["pattern"] in _PATTERNS:
        return f"expected {_PATTERNS[context['pattern']]}, got {got}"
    if kind in _LIMITS:
        prefix, key = _LIMITS[kind]
        limit = context.get(key, "")
        expected = f"{limit:.15g}" if isinstance(limit, float) else str(limit).replace("'", "")
        if has_hints and kind == "literal_error" and isinstance(error["input"], str):
            options = expected.replace(" or ", ", ").split(", ")
            hint = did_you_mean(error["input"], options)
            got += hint if hint.startswith(",") else ""
        return f"expected {prefix}{expected}, got {got}"
    if kind in _LENGTHS:
        bound, key, unit = _LENGTHS[kind]
        return f"expected {bound} {context.get(key)} {unit}, got {got}"
    message = str(context.get("error") or error["msg"])
    return f"{message[:1].lower()}{message[1:]}, got {got}"


def known_keys(model: Any, path: Path, *, member: str) -> list[str]:
    """Return the keys that *model* knows at *path*: of the union's *member*, or of all members together."""
    kinds = _types_at(model, path)
    meant = [kind for kind in kinds if getattr(kind, "__name__", "") == member]
    return list(dict.fromkeys(key for kind in meant or kinds for key in _fields(kind)))


def _about(model: Any, path: Path) -> str:
    """Return what kind of value is missing, if that is plain."""
    names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
    found = dict.fromkeys(names[kind] for kind in _types_at(model, path) if kind in names)
    return f"; expected {' or '.join(found)}" if found else ""


def _types_at(model: Any, path: Path) -> list[Any]:
    kinds = _members(model)
    for step in path:
        kinds = [member for kind in kinds for member in _members(_inside(kind, step))]
    return kinds


def _members(kind: Any) -> list[Any]:
    if kind is None:
        return []
    origin = typing.get_origin(kind)
    if origin is Annotated:
        return _members(typing.get_args(kind)[0])
    if origin in (Union, types.UnionType):
        return [member for option in typing.get_args(kind) for member in _members(option)]
    return [kind]


def _inside(kind: Any, step: str | int) -> Any:
    if isinstance(step, str) and _fields(kind):
        return _fields(kind).get(step)
    arguments = typing.get_args(kind)
    if isinstance(step, int) and arguments:
        return arguments[0]
    return arguments[1] if len(arguments) > 1 else None


def _fields(kind: Any) -> dict[str, Any]:
    if not isinstance(kind, type):
        return {}
    if dataclasses.is_dataclass(kind):
        names = [item.name for item in dataclasses.fields(kind) if item.init]
    else:
        names = list(getattr(kind, "model_fields", ()))
    hints = typing.get_type_hints(kind, include_extras=True) if names else {}
    return {written_name(kind, name): hints[name] for name in names}
