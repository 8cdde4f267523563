"""Records of a run as expectations look at them: by stream and agent, in batches, with the time of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from cosmos_cli.evidence.expectations.accumulators import Flags, Floats, Places, as_numbers
from madns_runtime.analysis.tables import RecordedTable, Tables
from madns_runtime.conditions.condition import AGENT, HOST, TIME
from madns_runtime.recording.records import HEALTH, NUMBER_KINDS, Field
from madns_runtime.recording.stream_rules import DETAILS

BATCH_RECORDS = 65_536
BEFORE_S = -1.0
"""Stands for a time before simulated time began, s."""
TABLE_NAMES = (
    ("agent", ""),
    (HOST, f"{HOST}_"),
    ("machine", "machine_"),
    ("device", "device_"),
)
"""Roles that record, and what the names of their tables begin with."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Some records of one agent."""

    agent: str
    is_of_host: bool
    """Whether the host's half recorded them, of this agent or of itself."""
    t_s: Floats
    columns: Mapping[str, NDArray[Any]]
    values: NDArray[Any]
    """Values of the field that was chosen; else empty."""
    places: Places
    """Places of the records among all of whoever recorded them."""
    has_begun: Flags
    """Whether simulated time ran when each was recorded; those of before count as time 0."""

    def has(self, field: str) -> bool:
        """Tell whether the records have a field."""
        return field in self.columns

    def of(self, field: str) -> Batch:
        """Return the records that have a value of this field."""
        values = self.columns[field]
        if values.dtype == object:
            there = np.array([each is not None and each == each for each in values.tolist()], bool)
        else:
            there = ~np.isnan(values.astype(np.float64))
        return self._where(there, values)

    def all(self) -> Batch:
        """Return all records, whatever their fields hold."""
        return replace(self, values=np.zeros(len(self.t_s)))

    def where(self, is_wanted: NDArray[np.bool_]) -> Batch:
        """Return some of the records that `of` or `all` returned."""
        return self if is_wanted.all() else self._where(is_wanted, self.values)

    def _where(self, wanted: NDArray[np.bool_], values: NDArray[Any]) -> Batch:
        if wanted.all():
            return replace(self, values=values)
        return replace(
            self,
            t_s=self.t_s[wanted],
            columns={},
            values=values[wanted],
            places=self.places[wanted],
            has_begun=self.has_begun[wanted],
        )


class RecordSource:
    """
    The records of a run.

    Args:
        tables: Of the run.
    """

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    def tables_of(self, stream: str) -> list[RecordedTable]:
        """Return the tables of a stream: of agents, of the host's half, of machines, of devices."""
        found = ((role, self._tables.get(f"{before}{stream}")) for role, before in TABLE_NAMES)
        return [table for role, table in found if table is not None and table.role == role]

    def sources_apart(self, stream: str) -> tuple[str, ...]:
        """Return the machines or devices that recorded a stream."""
        found = (table for table in self.tables_of(stream) if table.role in ("machine", "device"))
        return tuple(source for table in found for source in table.sources)

    def unit_of(self, stream: str, field: str, source: str) -> str:
        """Return the unit in which a source recorded a field; empty where nobody did."""
        tables = (table for table in self.tables_of(stream) if table.has(field))
        return next((table.unit(source, field) for table in tables), "")

    def may_have(self, stream: str, field: str) -> bool:
        """Tell whether records of a stream have a field, or may: an event carries more than its stream's fields."""
        return any(table.has(field) or table.has(DETAILS) for table in self.tables_of(stream))

    def has_time(self, stream: str) -> bool:
        """Tell whether records of a stream tell when they are of."""
        tables = self.tables_of(stream)
        return any(_time_field(stream, table.fields) for table in tables)

    def records_of(self, stream: str) -> int:
        """Return the number of records of a stream."""
        return sum(table.rows for table in self.tables_of(stream))

    def batches(self, stream: str, fields: Sequence[str]) -> Iterator[Batch]:
        """Yield all records of a stream with those of *fields* that it has, of one agent each."""
        for table in self.tables_of(stream):
            present = {each.name: each for each in table.fields}
            own = [name for name in fields if name in present]
            beside = [name for name in fields if name not in present and table.has(DETAILS)]
            time = _time_field(stream, table.fields)
            about = present.get(AGENT) if table.role == HOST else None
            has_agents = about is not None and about.kind == "str"
            wanted = {*own, *filter(None, [time]), *([AGENT] if has_agents else [])}
            names = list(wanted | ({DETAILS} if beside else set())) or [next(iter(present))]
            for source in table.sources:
                first, last_s = 0, None
                for columns in table.batches(source, names, BATCH_RECORDS):
                    columns = _with_details(columns, beside)
                    t_s, last_s = _times(columns, time, last_s)
                    has_begun = t_s >= 0.0
                    whole = Batch(
                        agent=source,
                        is_of_host=table.role == HOST,
                        t_s=np.maximum(t_s, 0.0),
                        columns=columns,
                        values=np.empty(0),
                        places=np.arange(first, first + len(t_s)),
                        has_begun=has_begun,
                    )
                    first += len(t_s)
                    yield whole
                    if has_agents:
                        yield from _split(whole)


def _split(whole: Batch) -> Iterator[Batch]:
    """Yield the records of the host's half once more, by the agent that each is about."""
    agents = whole.columns[AGENT].astype(str)
    names, inverse = np.unique(agents, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    ends = np.cumsum(np.bincount(inverse, minlength=len(names)))
    for name, rows in zip(names.tolist(), np.split(order, ends[:-1]), strict=True):
        yield replace(
            whole,
            agent=name,
            t_s=whole.t_s[rows],
            columns={key: values[rows] for key, values in whole.columns.items()},
            places=whole.places[rows],
            has_begun=whole.has_begun[rows],
        )


def _time_field(stream: str, fields: Sequence[Field]) -> str | None:
    """Return the field that tells a record's simulated time: t_s, or else the first one in seconds; None of health."""
    if any(each.name == TIME and each.kind in NUMBER_KINDS for each in fields):
        return TIME
    if stream == HEALTH.name:
        return None
    return next((each.name for each in fields if each.unit == "s" and each.kind == "float"), None)


def _times(
    columns: Mapping[str, NDArray[Any]], time: str | None, last_s: float | None
) -> tuple[Floats, float | None]:
    """
    Return the simulated time of each record, s, and the last that is known; *last_s* is that of the batch before.

    Records of whoever does not know the time yet are of before time 0, and of an agent that was started anew of the
    first time that it knows.
    """
    if time is None:
        return np.zeros(len(next(iter(columns.values())))), None
    values = columns[time]
    numbers = as_numbers(values)
    known = np.flatnonzero(~np.isnan(numbers))
    if len(known) < len(numbers):
        begins = 0 if last_s is not None else int(known[0]) if len(known) else len(numbers)
        behind = numbers[known[-1]] if len(known) else (last_s or 0.0)
        after = np.searchsorted(known, np.arange(len(numbers)))
        numbers = np.append(numbers[known], behind)[after]
        numbers[:begins] = BEFORE_S
    newest_s = float(numbers[known[-1]]) if len(known) else last_s
    return numbers, newest_s


def _with_details(
    columns: Mapping[str, NDArray[Any]], fields: Sequence[str]
) -> Mapping[str, NDArray[Any]]:
    """Return columns with those of *fields* that events carry beside their stream's own."""
    if not fields:
        return columns
    details = [_mapping(text) for text in columns[DETAILS].tolist()]
    found = dict(columns)
    for name in fields:
        column = np.empty(len(details), dtype=object)
        column[:] = [each.get(name) for each in details]
        found[name] = column
    return found


def _mapping(text: Any) -> Mapping[str, Any]:
    """Return what an event carries beside its fields; nothing of a field of that name that holds something else."""
    try:
        found = orjson.loads(text or "{}")
    except orjson.JSONDecodeError:
        return {}
    return found if isinstance(found, dict) else {}
