"""Values given with --set KEY=VALUE: they replace those of the file, and their place is the option."""

from __future__ import annotations

import contextlib
import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document, Path, SourcePlace, dotted, kind_of, read_value
from cosmos_cli.models.yaml_source import DEPTH_MAX, YamlSource

KEY_CHARACTERS_SHOWN = 60
OVERRIDES_MAX = 1000
TEXT_CHARACTERS_QUOTED = 60
_MARKS = tuple("[{\"'!&*|>")
"""Beginnings of what is meant as more than a bare text."""
_STEP = re.compile(r"([^.\[\]]+)|\[([0-9]{1,9})\]")
_INDEX = re.compile(r"[0-9]{1,9}")
KEY_FORM = re.compile(r"[^.\[\]]+(?:\.[^.\[\]]+|\[[0-9]{1,9}\])*")
"""A dotted path, such as agents.names[0]."""
GIVEN_TWICE = "is given twice, and only one could count"


@contextlib.contextmanager
def told_as_options(options: Mapping[str, str], given: Sequence[str]) -> Iterator[None]:
    """
    Name in faults the option that set a value, such as --duration, instead of a --set that nobody typed.

    Args:
        options: The command's options, by the keys that they set.
        given: KEY=VALUE of --set; a key that stands there as well is left as it was typed.

    Raises:
        InputError: As within.
    """
    try:
        yield
    except InputError as error:
        typed = {override_steps(each) for each in given}
        faults = [_told_as_option(fault, options, typed) for fault in error.faults]
        if faults == list(error.faults):
            raise
        raise InputError(faults=faults, omitted=error.omitted) from error


def _told_as_option(fault: Fault, options: Mapping[str, str], typed: set[tuple[str, ...]]) -> Fault:
    option = options.get(fault.override)
    if option is None:
        return fault
    if tuple(fault.override.split(".")) not in typed:
        return replace(fault, option=option)
    is_twice = fault.text == GIVEN_TWICE
    return replace(fault, text=f"{fault.text} ({option} sets it, too)") if is_twice else fault


def apply_overrides(document: Document, overrides: Sequence[str]) -> list[Fault]:
    """Apply every KEY=VALUE of --set, in order; return the faults of those that are malformed or have no place."""
    faults: list[Fault] = []
    seen: dict[tuple[str, ...], str] = {}
    if len(overrides) > OVERRIDES_MAX:
        text = f"expected at most {OVERRIDES_MAX} of --set, got {len(overrides)}; write a file"
        return [Fault(text=text, override=overrides[OVERRIDES_MAX].partition("=")[0])]
    for override in overrides:
        try:
            key, path, value, text = _parsed(override)
            _refuse_replacing(key, path, seen)
            written = _set_value(document, key, path, value)
            if text:
                document.texts[written] = text
        except InputError as error:
            faults += error.faults
    return faults


def _refuse_replacing(key: str, path: Path, seen: dict[tuple[str, ...], str]) -> None:
    """
    Enter a key of --set, unless it would replace what an earlier one said.

    Raises:
        InputError: It would, in silence.
    """
    steps = tuple(map(str, path))
    for other, other_key in seen.items():
        if other == steps:
            raise _override_error(key, GIVEN_TWICE)
        if other[: len(steps)] == steps:
            raise _override_error(key, f"would replace what --set {other_key} says; give it first")
    seen[steps] = key


def parse_override(override: str) -> tuple[str, Path, Any]:
    """
    Split KEY=VALUE; the value is read as YAML.

    Raises:
        InputError: There is no '=', the key is no dotted path, or the value no YAML.
    """
    return _parsed(override)[:3]


def override_steps(override: str) -> tuple[str, ...]:
    """Return a dotted key as its steps; of one that is no key, the whole, which is told of later."""
    try:
        _, path, _ = parse_override(override)
    except InputError:
        return (override,)
    return tuple(map(str, path))


def _parsed(override: str) -> tuple[str, Path, Any, str]:
    """Return key, path and value of KEY=VALUE, and the value as it is written if it is a plain scalar."""
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals:
        raise _override_error(override, "expected KEY=VALUE, such as agents.count=5")
    if not KEY_FORM.fullmatch(key):
        raise _override_error(key or override, "expected a dotted path, such as agents.names[0]")
    if len(_STEP.findall(key)) > DEPTH_MAX:
        text = f"expected at most {DEPTH_MAX} levels of nesting"
        raise _override_error(f"{key[:KEY_CHARACTERS_SHOWN]}...", text)
    path = tuple(
        int(index) if index else int(name) if _INDEX.fullmatch(name) else name
        for name, index in _STEP.findall(key)
    )
    try:
        value, written, faults = read_value(YamlSource.of("", text))
    except InputError as error:
        raise _override_error(key, _no_value(key, text) or error.faults[0].text) from None
    if faults:
        raise _override_error(key, faults[0].text)
    return key, path, value, written


def _no_value(key: str, text: str) -> str:
    """Return what is wrong with a text that YAML does not take as one, such as `:`; empty of a list, or a text in quotes."""
    if len(text) > TEXT_CHARACTERS_QUOTED or not text.isprintable() or text.strip()[:1] in _MARKS:
        return ""
    quoted = shlex.quote(f"{key}={json.dumps(text, ensure_ascii=False)}")
    return f"expected a value, got {text!r}; write a text in quotes: --set {quoted}"


def _set_value(document: Document, key: str, path: Path, value: Any) -> Path:
    """
    Replace the value at *path* by that of *key*, and return the path in the document's terms; what stood below is forgotten.

    Raises:
        InputError: There is no such place.
    """
    parent: Any = document.value
    written: Path = ()
    for step, following in zip(path, path[1:], strict=False):
        parent, written = _descend(document, parent, (*written, step), key, following)
    written = _assign(parent, (*written, path[-1]), key, value)
    for places in (document.value_places, document.key_places, document.texts):
        _forget(places, written)
    _place_at(document, written, key)
    return written


def _place_at(document: Document, path: Path, key: str) -> None:
    document.value_places[path] = document.key_places[path] = SourcePlace(override=key)


def _forget(places: dict[Path, Any], path: Path) -> None:
    for known in [known for known in places if known[: len(path)] == path]:
        del places[known]


def _override_error(key: str, text: str) -> InputError:
    return InputError(faults=[Fault(text=text, override=key)])


def _descend(
    document: Document, parent: Any, path: Path, key: str, following: str | int
) -> tuple[Any, Path]:
    """Return the container at *path*, made if it is not there, its place then that of *key*, and the path in its own terms."""
    fresh: Any = [] if isinstance(following, int) else {}
    path = _checked_step(parent, path, key)
    if isinstance(parent, list):
        index = int(path[-1])
        if index == len(parent):
            parent.append(fresh)
            _place_at(document, path, key)
        child = parent[index]
    else:
        if path[-1] not in parent:
            _place_at(document, path, key)
        child = parent.get(path[-1])
        if child is None:
            child = parent[path[-1]] = fresh
    if not isinstance(child, dict | list):
        raise _override_error(key, f"{dotted(path)} is {kind_of(child)} and has nothing inside")
    return child, path


def _assign(parent: Any, path: Path, key: str, value: Any) -> Path:
    path = _checked_step(parent, path, key)
    if isinstance(parent, list) and path[-1] == len(parent):
        parent.append(value)
    else:
        parent[path[-1]] = value
    return path


def _checked_step(parent: Any, path: Path, key: str) -> Path:
    """Return *path* with its last step as *parent* knows it: an index in a list, else a key."""
    step, above = path[-1], dotted(path[:-1])
    if not isinstance(parent, list):
        return (*path[:-1], str(step))
    if not isinstance(step, int):
        raise _override_error(key, f"{above} is a list: expected an index, got {step}")
    if step > len(parent):
        raise _override_error(key, f"{above} has {len(parent)} items: got the index {step}")
    return path
