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
    """Compare plain values; NaN is the same as NaN."""
    return json.dumps(made, sort_keys=True) == json.dumps(found, sort_keys=True)


def changed(made: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Say which fields of parameters came out another when they were made anew of their own values."""
    names = ", ".join(name for name in found if not is_same(made.get(name), found[name]))
    return (
        f"made anew of its own values, as host and agents do, {names} came out another; let"
        " __post_init__ keep what it made already"
    )
