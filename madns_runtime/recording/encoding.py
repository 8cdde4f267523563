"""How a record's values become one line of JSON, and which of them cannot. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import orjson

from madns_runtime.errors import PluginError

ENCODING = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE


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
    """Return how many NaN and infinite numbers a record holds: they are null in JSON."""
    if isinstance(value, float | np.floating):
        return 0 if math.isfinite(value) else 1
    if isinstance(value, np.ndarray):
        is_float = np.issubdtype(value.dtype, np.floating)
        return int(np.count_nonzero(~np.isfinite(value))) if is_float else 0
    if isinstance(value, Mapping):
        return sum(count_not_finite(item) for item in value.values())
    if isinstance(value, list | tuple):
        return sum(count_not_finite(item) for item in value)
    return 0


def explain_refusal(stream: str, values: Any, error: TypeError) -> PluginError:
    """Return the error for a record that has no JSON form, naming the value that is to blame."""
    items = values.items() if isinstance(values, Mapping) else enumerate(values)
    for name, value in items:
        try:
            orjson.dumps(value, to_plain, ENCODING)
        except TypeError as cause:
            return PluginError(f"stream {stream}: value {name}: {cause.__cause__ or cause}")
    return PluginError(f"stream {stream}: {error}")
