"""
Shapes of plain values: what a machine says is held against one before anybody works with it. Pure.

A shape is called with a value and the place where it stands; it raises `WrongShape` for the first thing
that is not what was expected.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

TEXT_CHARACTERS_MAX = 65_536
COUNT_MAX = 200_000
WHOLE_MAX = 2**63 - 1
SHOWN_CHARACTERS_MAX = 60

Shape = Callable[[object, str], None]


class WrongShape(ValueError):
    """
    A value is not what was expected.

    Args:
        where: Where it stands, such as .disk.free_bytes; empty for the whole.
        expected: In words.
        got: The value.
    """

    def __init__(self, where: str, expected: str, got: object) -> None:
        place = f"{where.lstrip('.')}: " if where else ""
        super().__init__(f"{place}expected {expected}, got {_shown(got)}")


def anything(value: object, where: str) -> None:
    """Accept whatever it is."""


def expecting(expected: str, is_expected: Callable[[object], bool]) -> Shape:
    """Return the shape of whatever passes a test; *expected* says in words what does."""

    def check(value: object, where: str) -> None:
        if not is_expected(value):
            raise WrongShape(where, expected, value)

    return check


def exactly(wanted: bool) -> Shape:
    """Return the shape of one truth value."""
    return expecting(str(wanted).lower(), lambda value: value is wanted)


def whole(low: int = 0, high: int = WHOLE_MAX) -> Shape:
    """Return the shape of a whole number within bounds."""
    bounds = f"from {low} on" if high == WHOLE_MAX else f"from {low} to {high}"
    return expecting(
        f"a whole number {bounds}",
        lambda value: (
            isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
        ),
    )


def _is_finite(value: object) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= WHOLE_MAX and math.isfinite(value)


nothing = expecting("nothing", lambda value: value is None)
flag = expecting("true or false", lambda value: isinstance(value, bool))
number = expecting("a finite number", _is_finite)


def text(pattern: str | None = None, *, characters_max: int = TEXT_CHARACTERS_MAX) -> Shape:
    """Return the shape of a text of bounded length, all of which matches a pattern where one is given."""
    compiled = re.compile(pattern, re.ASCII) if pattern is not None else None

    def check(value: object, where: str) -> None:
        if not isinstance(value, str):
            raise WrongShape(where, "a text", value)
        if len(value) > characters_max:
            raise WrongShape(where, f"a text of at most {characters_max} characters", value)
        if compiled is not None and compiled.fullmatch(value) is None:
            raise WrongShape(where, f"a text like {pattern}", value)

    return check


def one_of(words: Collection[str | int], what: str = "") -> Shape:
    """Return the shape of one of some words or numbers; *what* they are, where they are too many to be told."""

    def is_word(value: object) -> bool:
        return isinstance(value, str | int) and not isinstance(value, bool) and value in words

    return expecting(what or f"one of {', '.join(map(str, words))}", is_word)


def either(*shapes: Shape) -> Shape:
    """Return the shape of whatever has one of some shapes; the last one's fault is told."""

    def check(value: object, where: str) -> None:
        for shape in shapes[:-1]:
            with contextlib.suppress(WrongShape):
                return shape(value, where)
        return shapes[-1](value, where)

    return check


def maybe(shape: Shape) -> Shape:
    """Return the shape of null or another one."""

    def check(value: object, where: str) -> None:
        if value is not None:
            shape(value, where)

    return check


def list_of(shape: Shape) -> Shape:
    """Return the shape of a list of bounded length, all items alike."""

    def check(value: object, where: str) -> None:
        if not isinstance(value, list):
            raise WrongShape(where, "a list", value)
        if len(value) > COUNT_MAX:
            raise WrongShape(where, f"a list of at most {COUNT_MAX}", value)
        for index, item in enumerate(value):
            shape(item, f"{where}[{index}]")

    return check


def row(shapes: Sequence[Shape]) -> Shape:
    """Return the shape of a list that has an item for each of some shapes."""

    def check(value: object, where: str) -> None:
        if not isinstance(value, list) or len(value) != len(shapes):
            raise WrongShape(where, f"a list of {len(shapes)}", value)
        for index, (shape, item) in enumerate(zip(shapes, value, strict=True)):
            shape(item, f"{where}[{index}]")

    return check


def map_of(shape: Shape) -> Shape:
    """Return the shape of a map of bounded size, all values alike."""

    def check(value: object, where: str) -> None:
        items = _items(value, where)
        if len(items) > COUNT_MAX:
            raise WrongShape(where, f"a map of at most {COUNT_MAX}", value)
        for key, item in items.items():
            shape(item, f"{where}.{_shown_key(key)}")

    return check


def map_with(keys: Iterable[str], shape: Shape) -> Shape:
    """Return the shape of a map that has these keys and no others, all values alike."""
    return record(dict.fromkeys(keys, shape))


def record(
    required: Mapping[str, Shape],
    optional: Mapping[str, Shape] | None = None,
    *,
    is_open: bool = False,
) -> Shape:
    """
    Return the shape of a map with known keys.

    Args:
        required: Keys that must be there.
        optional: Keys that may be.
        is_open: Whether it may have others, with whatever value.
    """
    known = {**required, **(optional or {})}

    def check(value: object, where: str) -> None:
        items = _items(value, where)
        for key in required:
            if key not in items:
                raise WrongShape(where, f"a map with {key!r}", value)
        for key, item in items.items():
            if key in known:
                known[key](item, f"{where}.{key}")
            elif not is_open:
                raise WrongShape(where, f"a map without {_shown_key(key)!r}", value)

    return check


def _items(value: object, where: str) -> Mapping[str, object]:
    if not isinstance(value, dict):
        raise WrongShape(where, "a map", value)
    return value


def _shown_key(key: str) -> str:
    return key[:SHOWN_CHARACTERS_MAX]


def _shown(value: object) -> str:
    """Return a value in a few words: all of it may be large."""
    if value is None:
        return "null"
    if isinstance(value, dict):
        keys = ", ".join(_shown_key(key) for key in list(value)[:4])
        return f"a map of {len(value)} ({keys}{', ...' if len(value) > 4 else ''})"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, str):
        cut = value[:SHOWN_CHARACTERS_MAX]
        return ascii(cut) + ("..." if len(value) > len(cut) else "")
    if (
        isinstance(value, int)
        and not isinstance(value, bool)
        and abs(value) > 10**SHOWN_CHARACTERS_MAX
    ):
        return "a number of too many digits"
    return str(value).lower() if isinstance(value, bool) else str(value)
