"""Columns of a simulation's descriptor: the fields whose newest values whoever watches a run is shown. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import FRAMEWORK_SCHEMAS, StreamSchema

COLUMNS_MAX = 6
"""As many values of an agent as fit its ping."""


def shape_faults(columns: Any) -> list[str]:
    """Return what is wrong with columns before anything is known of streams."""
    if not isinstance(columns, tuple) or not all(map(_is_reference, columns)):
        return [f"columns: expected a tuple of texts 'stream.field', got {columns!r:.100}"]
    if len(columns) > COLUMNS_MAX:
        return [f"columns: expected at most {COLUMNS_MAX}, got {len(columns)}"]
    return []


def unknown_columns(columns: Sequence[str], streams: Iterable[DeclaredStream]) -> list[str]:
    """Return a fault per column that names no field of an agent's declared stream."""
    own = [stream for stream in streams if stream.role == "agent"]
    known = {f"{stream.name}.{field.name}" for stream in own for field in stream.fields}
    return [
        f"columns: {column!r} is no field of an agent's stream that streams() declares"
        for column in columns
        if column not in known
    ]


def label_column_remarks(column: str, streams: Iterable[DeclaredStream]) -> list[str]:
    """Return a remark per stream with a field that is called as the column of agents' second names."""
    every: list[DeclaredStream | StreamSchema] = [*streams, *FRAMEWORK_SCHEMAS.values()]
    return [
        f"label_column: stream {stream.name} has a field {column!r} of its own, so that its table names no agent by its"
        " label; choose another name"
        for stream in every
        if column in {field.name for field in stream.fields}
    ]


def _is_reference(value: object) -> bool:
    return isinstance(value, str) and all(value.partition("."))
