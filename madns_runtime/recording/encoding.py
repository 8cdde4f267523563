"""Encoding of a record's values as one line of JSON, and refusal of those that cannot be. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from madns_runtime.errors import PluginError

ENCODING = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE
_WHOLE = frozenset({type(None), bool, int, str})
_PLAIN = frozenset({tuple, list})
"""Types of most values; told apart first, for a record that holds None is looked through in its loop."""


def to_plain(value: Any) -> Any:
    """Return what orjson does not know by itself in a form that it does."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray | memoryview):
        return list(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def count_not_finite(value: Any) -> int:
    """Return how many NaN and infinite numbers a value that was encoded holds: they are null in JSON."""
    kind = type(value)
    if kind is float:
        return 0 if math.isfinite(value) else 1
    if kind in _WHOLE:
        return 0
    if kind in _PLAIN:
        return sum(map(count_not_finite, value))
    if isinstance(value, float | np.floating):
        return 0 if math.isfinite(value) else 1
    if isinstance(value, np.ndarray):
        return _count_in_array(value)
    if isinstance(value, np.void):  # a row of a structured array
        return count_not_finite(value.item())
    if isinstance(value, Enum):
        return count_not_finite(value.value)
    return sum(map(count_not_finite, _items(value)))


def _count_in_array(array: NDArray[Any]) -> int:
    """Return the same of an array; one whose numbers stand in objects, in rows or under a mask is taken apart."""
    # Not asked of an array of numpy's own: the first such question imports numpy.ma, in the middle of a tick.
    is_masked = type(array) is not np.ndarray and isinstance(array, np.ma.MaskedArray)
    if array.dtype.kind in "OV" or is_masked:
        return count_not_finite(array.tolist())
    is_float = np.issubdtype(array.dtype, np.floating)
    return int(np.count_nonzero(~np.isfinite(array))) if is_float else 0


def _items(value: Any) -> Iterable[Any]:
    """Return what the JSON of a value holds, in the order in which orjson tells the kinds apart."""
    if isinstance(value, str | list):
        return () if isinstance(value, str) else value
    if isinstance(value, dict):
        return value.values()
    if is_dataclass(value):
        named = getattr(value, "__dict__", None)
        if named is None:
            named = {field.name: getattr(value, field.name, None) for field in fields(value)}
        return (item for name, item in named.items() if not name.startswith("_"))
    if isinstance(value, Mapping):
        return value.values()
    if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray | memoryview):
        return value
    return ()


def explain_refusal(stream: str, values: Any, error: TypeError) -> PluginError:
    """Return the error for a record that has no JSON form, naming the value that is to blame."""
    items = values.items() if isinstance(values, Mapping) else enumerate(values)
    for name, value in items:
        try:
            orjson.dumps(value, to_plain, ENCODING)
        except TypeError as cause:
            return PluginError(f"stream {stream}: value {name}: {cause.__cause__ or cause}")
    return PluginError(f"stream {stream}: {error}")
