"""What figures are made from: the run's tables and its summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosmos_cli.expectation import mapping_at
from cosmos_cli.report.control import ControlRow
from cosmos_cli.report.sampling import Floats
from cosmos_cli.report.style import as_array
from cosmos_cli.statistics import TickStatistics
from cosmos_cli.tables import TableReader


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One run."""

    document: Mapping[str, Any]
    """run.json."""
    tables: Mapping[str, TableReader]
    tick_hz: float | None
    ticks: TickStatistics
    control: tuple[ControlRow, ...] = ()
    """A constellation's slots over time; empty for a run without."""
    unread: tuple[str, ...] = ()
    """Tables that the manifest lists and that are gone or cannot be read."""

    def agent_summary(self, name: str) -> Mapping[str, Any]:
        """Return what the agent's half of the simulation summed up; empty for one that died."""
        return mapping_at(self.document, "simulation", "agents", name)

    def packet_counts(self, name: str) -> Mapping[str, Any]:
        """Return how many packets of an agent were lost, duplicated and out of order, if any were counted."""
        return mapping_at(self.document, "packets", name)

    def time_of(self, table: TableReader, source: str) -> tuple[Floats, str]:
        """
        Return the abscissae of a source's records and what they are.

        Seconds since T0 where they are known; else the time since the first record; else its number.
        """
        if table.has("t_s"):
            return as_array(table.read(source, ("t_s",))["t_s"]), "simulated time, s"
        if table.has("packet") and self.tick_hz:
            packets = as_array(table.read(source, ("packet",))["packet"])
            return packets / self.tick_hz, "simulated time, s"
        if table.has("monotonic_s"):
            clock_s = as_array(table.read(source, ("monotonic_s",))["monotonic_s"])
            first_s = clock_s[0] if len(clock_s) else 0.0
            return clock_s - first_s, "time since the first sample, s"
        first = table.fields[0].name
        count = len(table.read(source, (first,))[first])
        return np.arange(count, dtype=np.float64), "record"

    def values(self, table: TableReader, source: str, name: str) -> Floats:
        """Return one field of a source as floats, null as NaN."""
        return as_array(table.read(source, (name,))[name])
