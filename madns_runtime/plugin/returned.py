"""What a plug-in's calls may return, checked where they return, so that the blame lands on the call."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import orjson

from madns_runtime.errors import PluginError
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.delivery import MESSAGE_BYTES_MAX

SUMMARY_BYTES_MAX = 1024 * 1024
"""A summary is figures; what is longer belongs into a stream of records."""


def initial_data(value: Any) -> Any:
    """
    Return an agent's initial data, which a message can carry.

    Raises:
        PluginError: It is no mapping, too large, or holds what messages do not carry.
    """
    if not isinstance(value, Mapping):
        raise PluginError(f"{_kind(value)}: expected a mapping")
    size = len(pack(value))
    if size > MESSAGE_BYTES_MAX - 1024:
        raise PluginError(f"{size} bytes: expected at most {MESSAGE_BYTES_MAX - 1024}")
    return value


def next_time(value: Any) -> float | None:
    """
    Return the simulated time that `timer` wants, s.

    Raises:
        PluginError: It is neither None nor a finite number.
    """
    if value is None:
        return None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value):
        raise PluginError(f"{value!r}: expected a simulated time in seconds, or None")
    return float(value)


def summary(value: Any) -> dict[str, Any]:
    """
    Return a summary as plain mappings, lists and scalars.

    Raises:
        PluginError: It is no mapping, too large, or has no JSON form.
    """
    if not isinstance(value, Mapping):
        raise PluginError(f"{_kind(value)}: expected a mapping; is a return missing?")
    try:
        text = orjson.dumps(dict(value), option=orjson.OPT_SERIALIZE_NUMPY)
    except TypeError as error:
        raise PluginError(f"a summary without a JSON form: {error}") from error
    if len(text) > SUMMARY_BYTES_MAX:
        raise PluginError(
            f"a summary of {len(text)} bytes: expected at most {SUMMARY_BYTES_MAX}; record long data"
        )
    plain: dict[str, Any] = orjson.loads(text)
    return plain


def _kind(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"
