"""Names of many machines in few characters, as an inventory would write them. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TypeVar

_Key = TypeVar("_Key")
RANGE_LENGTH_MIN = 3
_LAST_NUMBER = re.compile(r"^(.*?)(\d+)(\D*)$")


def names_by(pairs: Iterable[tuple[_Key, str]]) -> dict[_Key, list[str]]:
    """Return all names of each key, in the order in which they come."""
    found: dict[_Key, list[str]] = {}
    for key, name in pairs:
        found.setdefault(key, []).append(name)
    return found


def compact(names: Iterable[str]) -> str:
    """
    Return names with ranges for runs of numbers: pi[01:24], laptop.

    An inventory reads it so; to `--limit` brackets count places in a group.
    """
    pieces: list[str] = []
    run: list[str] = []
    for name in sorted(dict.fromkeys(names), key=_order):
        if run and not _follows(run, name):
            pieces += _written(run)
            run = []
        run.append(name)
    return ", ".join([*pieces, *_written(run)])


def _parts(name: str) -> tuple[str, str, str]:
    match = _LAST_NUMBER.match(name)
    return (match[1], match[2], match[3]) if match else (name, "", "")


def _order(name: str) -> tuple[str, str, int, str]:
    head, number, tail = _parts(name)
    return head, tail, int(number or 0), number


def _follows(run: list[str], name: str) -> bool:
    """Tell whether a name continues a run; one that began with zeros keeps its width."""
    head, number, tail = _parts(name)
    first, last = _parts(run[0])[1], _parts(run[-1])
    if not number or not last[1] or (head, tail) != (last[0], last[2]):
        return False
    if first.startswith("0") and len(number) != len(first):
        return False
    return number == f"{int(last[1]) + 1:0{len(last[1])}d}"


def _written(run: list[str]) -> list[str]:
    if len(run) < RANGE_LENGTH_MIN:
        return run
    head, first, tail = _parts(run[0])
    return [f"{head}[{first}:{_parts(run[-1])[1]}]{tail}"]
