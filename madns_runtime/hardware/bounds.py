"""Bounds that a dataclass declares for its fields (annotated_types), checked where a value of it is used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen


def bound_faults(value: Any, path: str) -> list[str]:
    """Return what of a dataclass's values, nested ones too, is beyond its bounds or no member of its literals."""
    found: list[str] = []
    for name, hint in get_type_hints(type(value), include_extras=True).items():
        found += _faults(hint, getattr(value, name), f"{path}.{name}")
    return found


def _faults(hint: Any, value: Any, path: str) -> Iterator[str]:
    arguments = get_args(hint)
    if get_origin(hint) is Annotated:
        yield from _faults(arguments[0], value, path)
        for bound in arguments[1:]:
            if (wanted := _beyond(bound, value)) is not None:
                yield f"{path}: expected {wanted}, got {value!r:.80}"
    elif get_origin(hint) is Literal:
        if value not in arguments:
            yield f"{path}: expected one of {', '.join(map(str, arguments))}; got {value!r:.80}"
    elif is_dataclass(value):
        if is_dataclass(hint) or hint is type(value):
            yield from bound_faults(value, path)
    elif isinstance(value, tuple) and arguments:
        for number, each in enumerate(value):
            yield from _faults(arguments[0], each, f"{path}[{number}]")
    elif value is not None and type(None) in arguments:
        for each in arguments:
            if get_origin(each) is Annotated:
                yield from _faults(each, value, path)


def _beyond(bound: Any, value: Any) -> str | None:
    """Return what a bound wants if a value does not keep it; None is let through: it is no value."""
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
    return None
