"""
Records of a run as columns: the protocol of its tables, and the run they belong to.

Who reads the files stands elsewhere: nothing here knows their format.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.values import SIMULATED_TIME, Axis, Floats
from madns_runtime.config import RunConfig
from madns_runtime.plain_values import mapping_at
from madns_runtime.recording.records import Field

AGENT = "agent"
INCARNATION = "incarnation"
OF_OTHER: Final = " · "
"""In a line's name, between an agent that recorded it and the other one that it is about."""
HOST_EVENTS: Final = "host_events"
SHUTDOWN_STATES: Final = ("BEGIN_SHUTDOWN", "EMERGENCY_SHUTDOWN")
Columns = Mapping[str, NDArray[Any]]
"""By the fields' names, shape (N,) each: numbers as float64 with null as NaN or as int64, the rest as objects."""


class RecordedTable(Protocol):
    """One stream of all who recorded it."""

    @property
    def name(self) -> str:
        """The stream's name; of the host host_..., of machines machine_..."""

    @property
    def role(self) -> str:
        """Recording role: agent, host or machine."""

    @property
    def rows(self) -> int:
        """Number of records of all sources."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the agents or machines that have records here, in order."""

    @property
    def fields(self) -> tuple[Field, ...]:
        """The recorded fields with their units; t_s, simulated time, first if it was made of a tick."""

    def unit(self, source: str, name: str) -> str:
        """Return the unit of a source's values of a field: its own one, where those of other devices measure something else."""

    def has(self, *names: str) -> bool:
        """Tell whether the table has all these columns."""

    def read(self, source: str, names: Iterable[str]) -> Columns:
        """Return columns of one source in the order of recording."""

    def batches(self, source: str, names: Iterable[str], rows_max: int) -> Iterator[Columns]:
        """Yield the same, at most *rows_max* records at a time."""

    def each(self, names: Iterable[str]) -> Iterator[tuple[str, Columns]]:
        """Yield every source with its columns."""


class ComparedStream(Protocol):
    """One stream of one source, from its table or from its lines."""

    @property
    def table(self) -> str:
        """Name of the table that it is in."""

    @property
    def role(self) -> str:
        """Recording role: agent, host or machine."""

    @property
    def source(self) -> str:
        """Name of the agent or machine."""

    @property
    def fields(self) -> tuple[Field, ...]:
        """The recorded fields with their units."""

    def names(self) -> tuple[str, ...]:
        """Return the names of the fields."""

    def batches(self, names: Iterable[str]) -> Iterator[Columns]:
        """Yield columns of all records in the order of recording, some thousands at a time."""


Key = tuple[str, str]
"""Table and source, such as ("state", "agent-03")."""
Tables = Mapping[str, RecordedTable]
"""A run's tables by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedRun:
    """One run."""

    document: Mapping[str, Any]
    """run.json."""
    tables: Tables
    config: RunConfig | None
    """Its settings; None where they are lost."""

    @property
    def tick_hz(self) -> float | None:
        """Rate of every agent's loop."""
        return None if self.config is None else self.config.agents.tick_hz

    @property
    def duration_s(self) -> float:
        """Simulated time that the run was to have, s: a stop shortens it; 0 where nothing tells."""
        planned_s = None if self.config is None else self.config.time.duration_s
        told = (planned_s, self.document.get("duration_s"))
        return min((float(each) for each in told if isinstance(each, int | float)), default=0.0)

    @property
    def end_s(self) -> float:
        """
        Simulated time at which it ended, s: its duration if it was complete, else the begin of its shutdown.

        Of a host that was killed, and told none, the newest that an agent recorded.
        """
        told = self.duration_s or math.inf
        if self.document.get("status") == "complete":
            return told
        ended_s = min(self._shutdowns_s(), default=None)
        return min(told, self._newest_s(told) if ended_s is None else ended_s)

    def _shutdowns_s(self) -> list[float]:
        """Return when the host told that the run ended, s."""
        table = self.tables.get(HOST_EVENTS)
        if table is None or not table.has("t_s", "event", "details"):
            return []
        return [
            float(t_s)
            for _, columns in table.each(("t_s", "event", "details"))
            for t_s, event, details in zip(
                as_array(columns["t_s"]), columns["event"], columns["details"], strict=True
            )
            if event == "state"
            and math.isfinite(t_s)
            and any(state in str(details) for state in SHUTDOWN_STATES)
        ]

    def _newest_s(self, otherwise_s: float) -> float:
        """Return the newest time of simulation that an agent recorded, s; *otherwise_s* if none did."""
        newest_s = 0.0
        for table in self.tables.values():
            if table.role == "agent" and table.has("t_s"):
                for _, columns in table.each(("t_s",)):
                    t_s = as_array(columns["t_s"])
                    newest_s = max(newest_s, float(t_s[np.isfinite(t_s)].max(initial=0.0)))
        return newest_s or otherwise_s

    def agent_summary(self, name: str) -> Mapping[str, Any]:
        """Return what the agent's half of the simulation summed up; empty for one that died."""
        return mapping_at(self.document, "simulation", "agents", name)

    def time_of(self, table: RecordedTable, source: str) -> tuple[Floats, Axis]:
        """
        Return the abscissae of a source's records and what they are.

        Seconds since T0 where they are known; else the time since the first record; else its number.
        """
        if table.has("t_s"):
            return self.values(table, source, "t_s"), SIMULATED_TIME
        if table.has("monotonic_s"):
            clock_s = self.values(table, source, "monotonic_s")
            first_s = clock_s[0] if len(clock_s) else 0.0
            return clock_s - first_s, Axis(quantity="time since the first sample", unit="s")
        first = table.fields[0].name
        count = len(table.read(source, (first,))[first])
        return np.arange(count, dtype=np.float64), Axis(quantity="record")

    def series(
        self, table: RecordedTable, name: str
    ) -> tuple[dict[str, tuple[Floats, Floats]], Axis]:
        """
        Return one field over time, abscissae and ordinates, by whose it is; and what the abscissae are.

        A stream with a text column `agent`, as a host records of all its agents, is one series per agent; records
        about none are whose they are.
        """
        found: dict[str, tuple[Floats, Floats]] = {}
        axis = Axis()
        for source in table.sources:
            x, axis = self.time_of(table, source)
            y = self.values(table, source, name)
            if not _names_agents(table):
                found[source] = (x, y)
                continue
            rows_of: dict[str, list[int]] = {}
            for row, agent in enumerate(table.read(source, (AGENT,))[AGENT].tolist()):
                whole = source if agent is None else str(agent)
                is_of_other = agent is not None and table.role == AGENT
                label = f"{source}{OF_OTHER}{agent}" if is_of_other else whole
                rows_of.setdefault(label, []).append(row)
            for label, rows in rows_of.items():
                found[label] = (x[rows], y[rows])
        return found, axis

    def returns(self, table: RecordedTable, source: str) -> NDArray[np.int64]:
        """Return the numbers of the records with which an agent that was away goes on, as its next incarnation."""
        if not table.has(INCARNATION):
            return np.empty(0, dtype=np.int64)
        incarnations = as_array(table.read(source, (INCARNATION,))[INCARNATION])
        return np.flatnonzero(np.diff(incarnations)) + 1

    def series_returns(
        self, table: RecordedTable, names: Iterable[str]
    ) -> dict[str, NDArray[np.int64]]:
        """Return the same by series, of those that hold all records of a source."""
        whole = () if _names_agents(table) else table.sources
        return {name: self.returns(table, name) for name in names if name in whole}

    def values(self, table: RecordedTable, source: str, name: str) -> Floats:
        """Return one field of a source as floats, null as NaN."""
        return as_array(table.read(source, (name,))[name])


def _names_agents(table: RecordedTable) -> bool:
    """Tell whether each record of a table says which agent it is about."""
    return any(field.name == AGENT and field.kind == "str" for field in table.fields)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedRun:
    """One of two runs that are compared."""

    run: RecordedRun
    streams: Mapping[Key, ComparedStream]
    """Those that were chosen for the comparison."""
    identical: Mapping[Key, int]
    """Streams that hold the same bytes in both runs, with their number of records: they need not be read."""
