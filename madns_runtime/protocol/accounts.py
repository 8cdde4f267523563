"""
Shapes of what agents tell of themselves: whether the host may reckon with it.

The wire carries any mapping. The host adds such numbers up, of all agents together, and writes the result as JSON: one
agent that told something else would end the run, and leave everybody without a result. Entries that nothing is reckoned
with may be anything; those of the last words also have a JSON form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from madns_runtime.protocol.messages import Service

NUMBER_MAX: Final = 2**48
"""Largest number that is taken: sums of 32 768 of them fit the 64 bits of JSON's whole numbers."""

_Shape = Mapping[str, Callable[[Any], bool]]


def is_report(report: Mapping[str, Any]) -> bool:
    """Tell whether a ping's report has the shape of one."""
    return _has_shape(report, _REPORT)


def is_summary(summary: Mapping[str, Any]) -> bool:
    """Tell whether the summary of an agent's run has the shape of one."""
    return _has_shape(summary, _SUMMARY) and _is_plain(summary)


def are_last_counts(records: Mapping[str, Any]) -> bool:
    """Tell whether an agent's counts at its end, once its records are closed, have their shape."""
    return _has_shape(records, _LAST_COUNTS) and _is_plain(records)


def _has_shape(told: Mapping[str, Any], shape: _Shape) -> bool:
    # A list: a report comes from each agent once per second, and a generator takes twice as long.
    return all([shape[name](value) for name, value in told.items() if name in shape])


def _is_number(value: Any) -> bool:
    # Neither true, which the sender does not mean as 1, nor what is not finite.
    return type(value) in (int, float) and -NUMBER_MAX <= value <= NUMBER_MAX


def _is_number_or_none(value: Any) -> bool:
    return value is None or _is_number(value)


def _is_text(value: Any) -> bool:
    return type(value) is str


def _is_list(value: Any) -> bool:
    return type(value) is list


def _is_device_and_reason(value: Any) -> bool:
    return type(value) is list and len(value) == 2 and all(map(_is_text, value))


def _are_answers(value: Any) -> bool:
    return type(value) is list and all(
        type(each) is list and len(each) == 2 and _is_number(each[0]) and _is_text(each[1])
        for each in value
    )


def _are_numbers(value: Any) -> bool:
    return type(value) is dict and all(map(_is_number, value.values()))


def _are_numbers_by_device(value: Any) -> bool:
    return type(value) is dict and all(map(_are_numbers, value.values()))


def _are_link_counters(value: Any) -> bool:
    return type(value) is dict and _has_shape(value, _LINK_COUNTERS)


def _is_plain(value: Any) -> bool:
    """Tell whether a decoded value has a JSON form: no bytes, which have none, and no arrays."""
    if type(value) is dict:
        return all(map(_is_plain, value.values()))
    if type(value) is list:
        return all(map(_is_plain, value))
    return value is None or type(value) in (bool, int, float, str)


_REPORT: Final[_Shape] = {
    "dropped": _is_number,
    "problem": _is_text,
    "ticks": _is_number,
    "missed": _is_number,
    "late_p50_us": _is_number,
    "late_p99_us": _is_number,
    "rtf": _is_number_or_none,
    "lost": _is_number,
    "columns": _is_list,
    "lost_device": _is_device_and_reason,
    "fault_answers": _are_answers,
}
_SUMMARY: Final[_Shape] = {"rtf": _is_number_or_none}
_LINK_COUNTERS: Final[_Shape] = {
    **{service.name.lower(): _are_numbers for service in Service},
    "deadlines_broken": _is_number,
}
_LAST_COUNTS: Final[_Shape] = {
    "messages": _are_link_counters,
    "between_agents": _are_numbers,
    "held_dropped": _is_number,
    "too_late": _is_number,
    "device_losses": _are_numbers_by_device,
}
