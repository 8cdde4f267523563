"""Values that a plug-in's parameters came to: whether messages and files can hold them, and whether they stay as they are."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.document import dotted
from cosmos_cli.models.yaml_source import WHOLE_MAX, WHOLE_MIN
from madns_runtime.plain_values import shown


def not_sendable(value: Any, path: ValuePath) -> Iterator[str]:
    """
    Say of each value that a run's messages and files cannot hold what is wrong: such a value is a default.

    A scenario's own values were looked at when they were read.
    """
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                yield f"{dotted(path)}: expected texts as keys, got {shown(key)}"
                continue
            yield from not_sendable(key, path)
            yield from not_sendable(item, (*path, key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from not_sendable(item, (*path, index))
    elif isinstance(value, float) and not math.isfinite(value):
        yield f"{dotted(path)}: expected a finite number, got {value}; None can stand for no limit"
    elif isinstance(value, int) and not WHOLE_MIN <= value <= WHOLE_MAX:
        yield f"{dotted(path)}: expected a whole number from -2^63 to 2^63 - 1"
    elif (
        isinstance(value, str)
        and not value.isascii()
        and value != value.encode("utf-8", "replace").decode("utf-8")
    ):
        yield f"{dotted(path)}: expected text that UTF-8 can hold, got {value!r:.60}"
    elif not isinstance(value, str | float | int | None):  # what a field of type Any may have
        yield (
            f"{dotted(path)}: expected None, true or false, a number, a text, a list or a mapping, got"
            f" {shown(value)}; turn it into one of these"
        )


def is_same(made: Any, found: Any) -> bool:
    """Compare plain values, those that were made anew with those before; a float of a whole number has its value."""
    if isinstance(made, Mapping) and isinstance(found, Mapping):
        return made.keys() == found.keys() and all(is_same(made[key], found[key]) for key in made)
    if isinstance(made, list) and isinstance(found, list):
        return len(made) == len(found) and all(map(is_same, made, found))
    if isinstance(made, float) and type(found) is int:  # a default such as 5 of a field of floats
        return made == found
    return json.dumps(made) == json.dumps(found)


def changed(made: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Say which fields of parameters came out another when they were made anew of their own values."""
    names = ", ".join(name for name in found if not is_same(made.get(name), found[name]))
    return (
        f"made anew of its own values, as host and agents do, {names} came out another; let"
        " __post_init__ keep what it made already"
    )
