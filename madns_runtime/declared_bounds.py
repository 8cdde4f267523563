"""Bounds that a dataclass declares for its fields (annotated_types), checked where a value of it is used."""

from __future__ import annotations

import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from itertools import repeat
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, GroupedMetadata, Gt, Le, Lt, MaxLen, MinLen, MultipleOf, Predicate

UNIONS = (Union, types.UnionType)
ROUNDING = 1e-9
"""Of a number, by which it may miss a multiple, as where scenarios are read."""


def bound_faults(value: Any, path: str) -> list[str]:
    """Return what of a dataclass's values, nested ones too, is beyond its bounds or no member of its literals."""
    found: list[str] = []
    for name, hint in get_type_hints(type(value), include_extras=True).items():
        found += _faults(hint, getattr(value, name), f"{path}.{name}")
    return found


def _faults(hint: Any, value: Any, path: str) -> Iterator[str]:
    """Yield what is wrong with a value of a kind that it is of; None is no value, and has no bounds."""
    if value is None:
        return
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        yield from _faults(arguments[0], value, path)
        for bound in _single(arguments[1:]):
            if (wanted := _beyond(bound, value)) is not None:
                yield f"{path}: expected {wanted}, got {value!r:.80}"
    elif origin is Literal:
        if value not in arguments:
            yield f"{path}: expected one of {', '.join(map(str, arguments))}; got {value!r:.80}"
    elif origin in UNIONS:
        found = [[*_faults(each, value, path)] for each in arguments if _may_be(each, value)]
        if all(found):  # it keeps the bounds of no member
            yield from next(iter(found), ())
    elif is_dataclass(value):
        yield from bound_faults(value, path)
    elif isinstance(value, tuple | list) and arguments:
        is_fixed = origin is tuple and arguments[-1] is not ...
        kinds = arguments if is_fixed else repeat(arguments[0])
        for number, (kind, each) in enumerate(zip(kinds, value, strict=False)):
            yield from _faults(kind, each, f"{path}[{number}]")
    elif isinstance(value, Mapping) and len(arguments) > 1:
        for key, each in value.items():
            yield from _faults(arguments[1], each, f"{path}.{key}")


def _may_be(hint: Any, value: Any) -> bool:
    """Tell whether a value may be of a member of a union."""
    origin = get_origin(hint)
    if origin is Annotated:
        return _may_be(get_args(hint)[0], value)
    if origin is Literal:
        return value in get_args(hint)
    kind = origin or hint
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int and isinstance(value, bool):
        return False
    return isinstance(value, kind) if isinstance(kind, type) else True


def _single(bounds: Iterable[Any]) -> Iterator[Any]:
    """Yield bounds one by one: such as Interval and Len are several."""
    for bound in bounds:
        if isinstance(bound, GroupedMetadata):
            yield from bound
        else:
            yield bound


def _beyond(bound: Any, value: Any) -> str | None:
    """Return what a bound wants if a value does not keep it; None if it does."""
    if isinstance(bound, MinLen):
        return f"at least {bound.min_length}" if len(value) < bound.min_length else None
    if isinstance(bound, MaxLen):
        return f"at most {bound.max_length}" if len(value) > bound.max_length else None
    if isinstance(bound, Ge):
        return None if value >= bound.ge else f"at least {bound.ge}"
    if isinstance(bound, Gt):
        return None if value > bound.gt else f"more than {bound.gt}"
    if isinstance(bound, Le):
        return None if value <= bound.le else f"at most {bound.le}"
    if isinstance(bound, Lt):
        return None if value < bound.lt else f"less than {bound.lt}"
    if isinstance(bound, MultipleOf):
        return (
            None if _is_multiple(value, bound.multiple_of) else f"a multiple of {bound.multiple_of}"
        )
    if isinstance(bound, Predicate):
        name = getattr(bound.func, "__qualname__", "its predicate")
        return None if bound.func(value) else f"a value for which {name} holds"
    return None


def _is_multiple(value: Any, of: Any) -> bool:
    """Tell whether a number is a multiple of another; but for rounding, where either is no whole one."""
    rest = abs(value % of)
    if isinstance(value, int) and isinstance(of, int):
        return bool(rest == 0)
    return bool(min(rest, abs(of) - rest) <= ROUNDING * abs(value))
