"""What differs between two trees of settings or summaries, by dotted key. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosmos_cli.verdict import is_number

ABSENT = None
OF_THE_RUN = ("run", "base_directory", "network.port")
"""What differs between any two runs and says nothing of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyDifference:
    """One key whose values differ; None where a run does not have it."""

    key: str
    a: Any
    b: Any

    def to_mapping(self) -> dict[str, Any]:
        """Return what --json prints."""
        return {"key": self.key, "a": self.a, "b": self.b}


def differing_keys(
    a: Mapping[str, Any], b: Mapping[str, Any], *, without: Sequence[str] = ()
) -> list[KeyDifference]:
    """
    Return the keys at which two trees differ, in the order of the first.

    Args:
        a: Mappings of mappings, lists and scalars.
        b: The same.
        without: Dotted keys that are not compared, nor what is below them.
    """
    of_a, of_b = dict(flat(a)), dict(flat(b))
    keys = dict.fromkeys((*of_a, *of_b))
    return [
        KeyDifference(key=key, a=of_a.get(key, ABSENT), b=of_b.get(key, ABSENT))
        for key in keys
        if not _is_same(of_a, of_b, key)
        and not any(key == other or key.startswith(f"{other}.") for other in without)
    ]


def flat(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Give every leaf with its dotted key; a list of scalars is one leaf."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from flat(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value):
            yield from flat(item, f"{key}[{number}]")
    else:
        yield key, list(value) if isinstance(value, tuple) else value


def _is_same(a: Mapping[str, Any], b: Mapping[str, Any], key: str) -> bool:
    if (key in a) != (key in b):
        # Null here and a mapping there: the keys of the mapping tell, and this one would tell nothing.
        return a.get(key) is None and b.get(key) is None
    left, right = a[key], b[key]
    return bool(left == right) and is_number(left) == is_number(right)
