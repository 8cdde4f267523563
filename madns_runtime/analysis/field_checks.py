"""
Checks of fields that values of figures are made of.

What does not fit is refused where a value is made: an error names the line of whoever made it, and whoever draws
need not expect anything else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.plain_values import is_whole, shown

NO_REALS = "cMm"
"""Kinds of arrays that NumPy makes floats of by dropping what they mean: complex numbers, dates, spans of time."""


def real_array(values: Any, place: str) -> NDArray[np.float64]:
    """
    Return values as an array of floats, those under a mask as NaN; *place* is for the message.

    Raises:
        ValueError: They are no real numbers; or NumPy's own, with a TypeError as well.
    """
    array = np.asanyarray(values)
    if array.dtype.kind in NO_REALS:
        raise ValueError(f"{place}: expected real numbers, got {array.dtype}")
    floats = array.astype(np.float64, copy=False)
    return np.asarray(floats.filled(np.nan) if isinstance(floats, np.ma.MaskedArray) else floats)


def hold_arrays(owner: Any, shapes: Mapping[str, int]) -> None:
    """Turn fields of *owner* into arrays of so many dimensions."""
    for name, dimensions in shapes.items():
        array = real_array(getattr(owner, name), _place(owner, name))
        if array.ndim != dimensions:
            raise ValueError(
                f"{_place(owner, name)}: expected {dimensions} dimensions, got {array.ndim}"
            )
        object.__setattr__(owner, name, array)


def hold_same(owner: Any, *names: str) -> None:
    """Turn fields of *owner* into arrays of one dimension and one length."""
    hold_arrays(owner, dict.fromkeys(names, 1))
    lengths = {name: len(getattr(owner, name)) for name in names}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"{type(owner).__name__}: expected one length, got {told}")


def hold_numbers(owner: Any, *names: str) -> None:
    """Turn fields of *owner* into floats."""
    for name in names:
        object.__setattr__(owner, name, as_number(getattr(owner, name), _place(owner, name)))


def as_number(value: Any, place: str) -> float:
    """Return a number as a float; *place* is for the message."""
    try:
        if isinstance(value, int | float | np.integer | np.floating):
            return float(value)
    except OverflowError:
        pass
    raise ValueError(f"{place}: expected a number, got {shown(value)}")


def hold_texts(owner: Any, *names: str) -> None:
    """Refuse fields of *owner* that are no texts."""
    for name in names:
        hold_kind(owner, name, str, "a text")


def hold_kind(owner: Any, name: str, kind: type | tuple[type, ...], words: str) -> None:
    """Refuse a field of *owner* that is of no such kind; *words* say of which."""
    value = getattr(owner, name)
    if not isinstance(value, kind):
        raise ValueError(f"{_place(owner, name)}: expected {words}, got {type(value).__name__}")


def hold_list(owner: Any, name: str, kind: type | tuple[type, ...], words: str) -> None:
    """Turn an array in a field of *owner* into a list, and refuse what is none, or holds something of another kind."""
    listed = getattr(owner, name)
    if isinstance(listed, np.ndarray):
        listed = listed.tolist()
        object.__setattr__(owner, name, listed)
    if isinstance(listed, str) or not isinstance(listed, Sequence):
        raise ValueError(
            f"{_place(owner, name)}: expected a list, got {type(listed).__name__}; each is {words}"
        )
    for number, value in enumerate(listed):
        if not isinstance(value, kind):
            raise ValueError(
                f"{_place(owner, name)}[{number}]: expected {words}, got {type(value).__name__}"
            )


def hold_word(owner: Any, name: str, words: tuple[str, ...]) -> None:
    """Refuse a field of *owner* that is none of *words*."""
    value = getattr(owner, name)
    if not isinstance(value, str) or value not in words:
        raise ValueError(
            f"{_place(owner, name)}: expected one of {', '.join(words)}, got {shown(value)}"
        )


def hold_whole(owner: Any, name: str) -> None:
    """Refuse a field of *owner* that is no whole number."""
    value = getattr(owner, name)
    if not is_whole(value):
        raise ValueError(f"{_place(owner, name)}: expected a whole number, got {shown(value)}")


def table_rows(rows: Any, width: int, title: str) -> list[Sequence[Any]]:
    """Return a table's rows, arrays as lists; refuse other values, and rows of another length."""
    if isinstance(rows, str | Mapping) or not isinstance(rows, Sequence | np.ndarray):
        raise ValueError(f"table {title!r}: expected a list of rows, got {type(rows).__name__}")
    found = []
    for number, given in enumerate(rows):
        row = given.tolist() if isinstance(given, np.ndarray) else given
        if isinstance(row, str) or not isinstance(row, Sequence):
            raise ValueError(
                f"table {title!r}: row {number}: expected a list of cells, got {type(row).__name__}"
            )
        if len(row) != width:
            raise ValueError(
                f"table {title!r}: row {number} has {len(row)} cells, the head {width}"
            )
        found.append(row)
    return found


def _place(owner: Any, name: str) -> str:
    return f"{type(owner).__name__}.{name}"
