"""
Newest values of some recorded fields, for whoever watches a run.

A record is decoded when somebody asks, a few times per second; recording does nothing for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from madns_runtime.recording.records import WHOLE_MAX

if TYPE_CHECKING:
    # Who only cleans values, as the operator's side does, is spared numpy.
    from madns_runtime.recording.recorder import Recorder

AGENTS_TOLD_MAX = 64
"""Agents whose values a report on a run's progress tells; the others are counted."""
TEXT_CHARACTERS_MAX = 16
"""Of a text; so cut, the values of all columns fit the datagram of a ping."""

Value = float | str | None


class NewestValues:
    """
    The values of an agent's columns.

    Args:
        recorder: The agent's.
        columns: Fields as `stream.field`.
    """

    def __init__(self, recorder: Recorder, columns: Sequence[str]) -> None:
        self._recorder = recorder
        self._fields = [column.split(".", 1) for column in columns]

    def read(self) -> list[Value]:
        """Return one value per column; None where nothing is recorded."""
        records = {stream: self._recorder.newest(stream) for stream, _ in self._fields}
        return clean_values([records[stream].get(field) for stream, field in self._fields])


def clean_values(values: object, count: int | None = None) -> list[Value]:
    """
    Return what may be shown of values that a plug-in recorded or another machine told.

    Args:
        values: A list; anything else holds no value.
        count: How many are expected; None for as many as there are.
    """
    told = values if isinstance(values, list) else []
    count = len(told) if count is None else count
    return [*map(_clean, told[:count]), *[None] * (count - len(told))]


def _clean(value: object) -> Value:
    if isinstance(value, str):
        return value[:TEXT_CHARACTERS_MAX]
    if isinstance(value, int) and abs(value) <= WHOLE_MAX:
        return value
    return value if isinstance(value, float) and math.isfinite(value) else None


def told_columns(columns: Sequence[str], values: Sequence[tuple[str, object]]) -> dict[str, object]:
    """
    Return what a report on a run's progress tells of columns; nothing without any.

    Args:
        columns: Fields as `stream.field`.
        values: Each agent that has told its values, and what it told.
    """
    if not columns:
        return {}
    told = values[:AGENTS_TOLD_MAX]
    return {
        "columns": list(columns),
        "values": {agent: clean_values(own, len(columns)) for agent, own in told},
        "values_left_out": len(values) - len(told),
    }
