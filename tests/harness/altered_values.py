"""Plain values with one thing in them that nobody expects, chosen by a seed."""

from __future__ import annotations

import copy
import random
from collections.abc import Iterator
from typing import Any

HOSTILE: tuple[Any, ...] = (
    None,
    True,
    False,
    -1,
    0,
    10**400,
    -(10**30),
    1e308,
    1.5,
    "",
    "x",
    "x" * 300_000,
    "\ud800\x1b]0;owned\x07\u202e",
    "../../etc/passwd",
    [],
    {},
    [None],
    {"": None},
    [[[[[]]]]],
    {"a": {"b": {"c": [1, 2, {"d": None}]}}},
)


REMOVED = object()


def altered(value: Any, chance: random.Random) -> Any:
    """Return a value with one thing in it replaced, removed or added."""
    value = copy.deepcopy(value)
    places = list(_places(value))
    if not places:
        return chance.choice(HOSTILE)
    holder, key = chance.choice(places)
    match chance.randrange(5):
        case 0 if isinstance(holder, dict):
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder["unheard-of"] = chance.choice(HOSTILE)
        case 2 if isinstance(holder, list):
            holder.extend([holder[key]] * 3)
        case _:
            holder[key] = chance.choice(HOSTILE)
    return value


def all_altered(value: Any) -> Iterator[Any]:
    """Yield a value with each thing in it replaced by each of HOSTILE, or removed, one at a time."""
    for index in range(len(list(_places(value)))):
        for instead in (*HOSTILE, REMOVED):
            copied = copy.deepcopy(value)
            holder, key = list(_places(copied))[index]
            if instead is not REMOVED:
                holder[key] = instead
            elif isinstance(holder, dict):
                del holder[key]
            yield copied


def _places(value: Any) -> Any:
    keys = value if isinstance(value, dict) else range(len(value) if isinstance(value, list) else 0)
    for key in list(keys):
        yield value, key
        yield from _places(value[key])
