"""Recorded values as columns, and columns joined, so that no value becomes another. numpy alone."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.recording.records import WHOLE_MAX

Columns = dict[str, NDArray[Any]]
_NUMBERS = frozenset({float, int, bool, NoneType})


def column_of(values: list[Any], kind: str) -> NDArray[Any]:
    """
    Return values of a field of this kind as an array.

    Floats are float64 with null as NaN; ints int64, or float64 where some are null or broken, unless one is too
    large for that; bools bool; all else is object, with null as None.
    """
    try:
        if kind in ("float", "int"):
            return _number_column(values, np.float64 if kind == "float" else np.int64)
        if kind == "bool" and all(type(value) is bool for value in values):
            return np.array(values, dtype=np.bool_)
    except (TypeError, ValueError, OverflowError):
        pass  # Not what the schema says: kept as it is.
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column


def _number_column(values: list[Any], wanted: type[np.float64 | np.int64]) -> NDArray[Any]:
    """
    Return numbers as an array, whole ones as floats where there are others among them, or none in a place.

    Raises:
        ValueError: A value is no number: NumPy would take a text for its number, and a list for a row. Or a whole
            one that no float is, such as nanoseconds of an epoch, would have to become one.
    """
    if not values:
        return np.empty(0, dtype=wanted)
    try:
        # NumPy is not asked first: of one long text among many numbers it makes as long a text for each.
        return np.frombuffer(array("q" if wanted is np.int64 else "d", values), dtype=wanted)
    except (TypeError, OverflowError):
        pass  # Not numbers alone, or whole ones among which there is another.
    if not _NUMBERS.issuperset(map(type, values)):
        raise ValueError("a value is no number")
    if wanted is np.int64 and any(type(each) is int and abs(each) > WHOLE_MAX for each in values):
        raise ValueError("a value is no float")
    return np.array(values, dtype=np.float64)


def joined_column(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return parts of one column, at least one, as one: objects where they would become others as floats."""
    kinds = {part.dtype.kind for part in parts}
    if len(kinds) > 1 and ("O" in kinds or any(map(_has_large, parts))):
        return np.concatenate([part.astype(object) for part in parts])
    return np.concatenate(parts)


def _has_large(column: NDArray[Any]) -> bool:
    if column.dtype.kind != "i":
        return False
    return bool(((column > WHOLE_MAX) | (column < -WHOLE_MAX)).any())
