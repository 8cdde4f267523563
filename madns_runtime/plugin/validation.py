"""Validation of what a plug-in's calls return, done where they return: the blame lands on the call."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import orjson

from madns_runtime.errors import PluginError
from madns_runtime.plain_values import is_nested_deeper, is_real
from madns_runtime.protocol.codec import (
    DEPTH_MAX,
    ITEMS_MAX,
    UnencodableValue,
    encode_message,
    pack,
    unpack,
)
from madns_runtime.protocol.datagram import MESSAGE_BYTES_MAX
from madns_runtime.protocol.messages import SimulationComplete
from madns_runtime.recording.encoding import count_not_finite

SUMMARY_BYTES_MAX = 1024 * 1024
"""A summary is figures; what is longer belongs into a stream of records."""
SUMMARY_LEVELS_MAX = 200
"""Lists and mappings of a summary in each other: it lies in the host's result, and that in messages and in run.json, of
which none may have 255 levels. An agent's has fewer: it travels in a message."""
NOT_FINITE_CHECK = "summary.not_finite"


def initial_data(value: Any) -> Any:
    """
    Return an agent's initial data as they are now: whoever returned them may go on to change them, such as for the next agent.

    Raises:
        PluginError: It is no mapping, too large, or holds what messages do not carry.
    """
    if not isinstance(value, Mapping):
        raise PluginError(f"{_kind(value)}: expected a mapping")
    packed = pack(value)
    if len(packed) > MESSAGE_BYTES_MAX - 1024:
        raise PluginError(f"{len(packed)} bytes: expected at most {MESSAGE_BYTES_MAX - 1024}")
    return unpack(packed)


def medium(value: Any) -> Any:
    """
    Return what is to carry messages between agents; None for nothing.

    Raises:
        PluginError: It cannot.
    """
    if value is not None and not callable(getattr(value, "carry", None)):
        raise PluginError(f"{_kind(value)}: expected a medium with a method carry(), or None")
    return value


def next_time(value: Any) -> float | None:
    """
    Return the simulated time that `timer` wants, s.

    Raises:
        PluginError: It is neither None nor a finite number.
    """
    if value is None:
        return None
    try:
        # With NumPy's, which a time becomes by one operand of theirs.
        time_s = float(value) if is_real(value) else math.nan
    except OverflowError:  # a whole number beyond what a float holds has no short text either
        raise PluginError(
            "a whole number without end: expected a simulated time in seconds"
        ) from None
    if not math.isfinite(time_s):
        raise PluginError(f"{value!r}: expected a simulated time in seconds, or None")
    return time_s


def summary(value: Any) -> dict[str, Any]:
    """
    Return a summary as plain mappings, lists and scalars.

    JSON has no number that is not finite: such values are null there, and a broken check tells of them.

    Raises:
        PluginError: It is no mapping, too large, nested too deep, or has no JSON form.
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
    if is_nested_deeper(plain, SUMMARY_LEVELS_MAX):
        raise PluginError(
            f"a summary of more than {SUMMARY_LEVELS_MAX} lists and mappings in each other: a summary is figures"
        )
    not_finite = count_not_finite({key: item for key, item in value.items() if key != "checks"})
    checks = plain.setdefault("checks", []) if not_finite else None
    if isinstance(checks, list):
        checks.append({"name": NOT_FINITE_CHECK, "limit": 0, "got": not_finite, "passed": False})
    return plain


def agent_summary(value: Any) -> dict[str, Any]:
    """
    Return the summary of an agent's half, which travels in its last message, as `summary` does.

    Raises:
        PluginError: As there; or it holds what messages do not carry.
    """
    plain = summary(value)
    try:
        encode_message(SimulationComplete({"simulation": plain}))
    except UnencodableValue:
        raise PluginError(
            f"a summary that no message carries: expected lists and mappings of at most {ITEMS_MAX} items, and at most"
            f" {DEPTH_MAX - 2} of them in each other; record long data"
        ) from None
    return plain


def _kind(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"


HOST_CHECKS: Final[Mapping[str, Callable[[Any], Any]]] = {
    "initial_data": initial_data,
    "medium": medium,
    "timer": next_time,
    "finish": summary,
}
"""Checks of what methods of a host's half return, by method; values of other methods are not looked at."""
AGENT_CHECKS: Final[Mapping[str, Callable[[Any], Any]]] = {"finish": agent_summary}
"""Checks of what an agent's half returns, by method."""
