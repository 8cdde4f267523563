"""
The layout of a table: the columns in which the records of all files of one stream have room. Pure.

A column of numbers has one unit: what a file records in another one that measures the same is converted to it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pyarrow as pa
from numpy.typing import NDArray

from cosmos_cli.evidence.arrow_values import ARROW_TYPES
from cosmos_cli.evidence.streams import DETAILS, RecordFile
from cosmos_cli.evidence.table_labels import TableLabels
from madns_runtime.analysis.tables import AGENT, INCARNATION
from madns_runtime.conditions.condition import TIME
from madns_runtime.plain_values import is_real
from madns_runtime.recording.columns import column_of
from madns_runtime.recording.records import NUMBER_KINDS, Field
from madns_runtime.units import conversion, converted

SIMULATED_UTC = "simulated_utc"
METADATA_KEY = b"cosmos"
UNITS_KEY = b"units"
"""Metadata of a column that has no unit of its own: those of its sources."""
NO_LABELS = TableLabels()
DEVICE = "device"
"""Role of devices: those of one name are no copies of each other, as agents are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TableLayout:
    """The columns of one table: fields over all its streams, and what is added to them."""

    name: str
    role: str
    source_column: str
    fields: tuple[Field, ...]
    tick_hz: float | None
    """Rate from which t_s is made of the field tick; None where there is nothing to make."""
    labels: TableLabels = NO_LABELS
    """Columns that are added to each record."""
    units: Mapping[str, Mapping[str, str]]
    """Units by source of numbers whose column has none, by field: of devices that measure different things."""

    @property
    def _names(self) -> set[str]:
        return {field.name for field in self.fields}

    @property
    def has_utc(self) -> bool:
        """Whether each record's simulated time is told as UTC, too."""
        has_time = self.tick_hz is not None or TIME in self._names
        return has_time and self.labels.zero_utc is not None and SIMULATED_UTC not in self._names

    @property
    def label(self) -> str | None:
        """Name of the column with the second name of each record's agent; None if there is none."""
        is_of_agents = self.role == "agent" or AGENT in self._names
        labels = self.labels.agents
        is_free = labels.column not in (*self._names, self.source_column)
        return labels.column if is_of_agents and labels.names and is_free else None

    def arrow_schema(self) -> pa.Schema:
        """Return the table's schema; each field knows its unit."""
        columns = [
            pa.field(self.source_column, pa.dictionary(pa.int32(), pa.string())),
            pa.field(INCARNATION, pa.int32()),
        ]
        if self.tick_hz is not None:
            columns.append(pa.field(TIME, pa.float64(), metadata={"unit": "s"}))
        if self.has_utc:
            columns.append(pa.field(SIMULATED_UTC, pa.timestamp("us", tz="UTC")))
        if self.label:
            columns.append(pa.field(self.label, pa.dictionary(pa.int32(), pa.string())))
        for field in self.fields:
            about: dict[str | bytes, str] = {"unit": field.unit, "kind": field.kind}
            if field.name in self.units:
                about[UNITS_KEY] = json.dumps(self.units[field.name])
            columns.append(pa.field(field.name, ARROW_TYPES[field.kind], metadata=about))
        note = {
            "table": self.name,
            "role": self.role,
            "source_column": self.source_column,
            "labels": [
                *([SIMULATED_UTC] if self.has_utc else []),
                *([self.label] if self.label else []),
            ],
        }
        return pa.schema(columns, metadata={METADATA_KEY: json.dumps(note).encode()})


def plan_table(
    files: Sequence[RecordFile], tick_hz: float | None, labels: TableLabels = NO_LABELS
) -> TableLayout:
    """
    Return the layout that holds every record of *files*, which are of one table.

    Where incarnations or agents disagree on a field's kind, the wider one holds both: a float holds an
    int, and text holds anything. Where they disagree on its unit, the first one's holds for numbers, and
    text has none; nor has a column of devices of one name that measure different things. Packed fields have
    no column: only their simulation reads them.
    """
    merged: dict[str, Field] = {}
    role = files[0].role
    for file in files:
        for field in (*file.fields, *(() if file.is_array else (DETAILS,))):
            known = merged.get(field.name)
            merged[field.name] = field if known is None else _wider(known, field, role)
    has_tick = "tick" in merged and merged["tick"].kind in NUMBER_KINDS
    needs_time = has_tick and "t_s" not in merged and role == "agent"
    source_column: str = role
    while source_column in merged:
        source_column += "_name"
    return TableLayout(
        name=files[0].table,
        role=role,
        source_column=source_column,
        fields=tuple(f for f in merged.values() if f.name != INCARNATION and f.kind != "packed"),
        tick_hz=tick_hz if needs_time else None,
        labels=labels,
        units=_units_apart(files, merged) if role == DEVICE else {},
    )


def _units_apart(
    files: Sequence[RecordFile], merged: Mapping[str, Field]
) -> dict[str, dict[str, str]]:
    """Return the units by source of numbers whose column has none, by field."""
    units: dict[str, dict[str, str]] = {}
    for file in files:
        for own in file.fields:
            column = merged[own.name]
            if own.unit and not column.unit and column.kind in NUMBER_KINDS:
                units.setdefault(own.name, {})[file.source] = own.unit
    return units


def in_unit(values: NDArray[Any], unit: str, column: Field, role: str) -> tuple[NDArray[Any], int]:
    """
    Return a file's values of a field in the unit of its column, and how many became null on the way.

    Args:
        values: As recorded.
        unit: Of them.
        column: The field as the table has it. Text stays as it was recorded, and so do devices' numbers where it has no unit.
        role: The table's.
    """
    if column.kind not in NUMBER_KINDS or (role == DEVICE and not column.unit):
        return values, 0
    factor = _factor(unit, column.unit)
    if factor == 1.0:
        return values, 0
    told = values.tolist()
    made = [_scaled(value, factor) if is_real(value) else value for value in told]
    lost = sum(new is None and old is not None for old, new in zip(told, made, strict=True))
    return column_of(made, "float"), lost


def _factor(unit: str, wanted: str) -> float | None:
    """Return the factor from one unit to another; one that is not given is that of a bare number."""
    return 1.0 if {unit, wanted} == {"", "1"} else conversion(unit, wanted)


def _scaled(value: float, factor: float | None) -> float | None:
    """Return a number in another unit; None where there is no factor, or it is too large there."""
    try:
        if math.isnan(value):
            return value
        number = math.inf if factor is None else converted(value, factor)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _wider(first: Field, second: Field, role: str) -> Field:
    kinds = {first.kind, second.kind}
    kind = first.kind
    if kinds == {"int", "float"}:
        kind = "float"
    elif len(kinds) > 1:
        kind = "json"
    if first.unit == second.unit:
        return replace(first, kind=kind)
    is_apart = role == DEVICE and (not first.unit or _factor(second.unit, first.unit) is None)
    if kind not in NUMBER_KINDS or is_apart:
        return replace(first, unit="", kind=kind)
    is_whole = _factor(second.unit, first.unit) in (None, 1.0)
    return replace(first, kind=kind if is_whole else "float")
