"""Figures of a run from all its samples: ticks, lateness, margin, round trips, clock. Reads tables, writes nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.tables import TableReader

Floats = NDArray[np.float64]
US_PER_MS = 1000.0
ROUND_TRIP = "round_trip_us"
FRAMEWORK_TABLES = ("ticks", "clock", "events", "log", "process")


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentTicks:
    """One agent's ticks, all incarnations together."""

    run: int
    missed: int
    lateness_ms: Mapping[str, float]
    margin_ms: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Statistics of one quantity of one source."""

    count: int
    mean: float
    sd: float
    min: float
    max: float
    p50: float
    p99: float
    p999: float

    @property
    def range(self) -> float:
        """Largest minus smallest."""
        return self.max - self.min

    def to_mapping(self) -> dict[str, float]:
        """Return the statistics as run.json holds them."""
        values = {name: getattr(self, name) for name in self.__slots__} | {"range": self.range}
        return {name: _rounded(value) for name, value in values.items()}


def summarise(samples: NDArray[Any]) -> Summary | None:
    """Return the statistics of all finite samples; None if there are none."""
    values = samples.astype(np.float64, copy=False)
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    p50, p99, p999 = np.percentile(values, (50, 99, 99.9))
    return Summary(
        count=int(values.size),
        mean=float(values.mean()),
        sd=float(values.std()),
        min=float(values.min()),
        max=float(values.max()),
        p50=float(p50),
        p99=float(p99),
        p999=float(p999),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class TickStatistics:
    """Every recorded tick of a run."""

    agents: Mapping[str, AgentTicks]
    lateness_ms: Mapping[str, float]
    margin_ms: Mapping[str, float]


def tick_statistics(table: TableReader | None) -> TickStatistics:
    """Return lateness and margin over all ticks of all agents, and by agent."""
    agents: dict[str, AgentTicks] = {}
    lateness: list[NDArray[Any]] = []
    margin: list[NDArray[Any]] = []
    if table is not None and table.has("lateness_us", "margin_us", "missed"):
        for name, columns in table.each(("lateness_us", "margin_us", "missed")):
            late, left = _small(columns["lateness_us"]), _small(columns["margin_us"])
            lateness.append(late)
            margin.append(left)
            agents[name] = AgentTicks(
                run=len(late),
                missed=int(np.nansum(columns["missed"])),
                lateness_ms=high_quantiles(late / US_PER_MS),
                margin_ms=low_quantiles(left / US_PER_MS),
            )
    return TickStatistics(
        agents=agents,
        lateness_ms=high_quantiles(_joined(lateness) / US_PER_MS),
        margin_ms=low_quantiles(_joined(margin) / US_PER_MS),
    )


def high_quantiles(samples: NDArray[Any]) -> dict[str, float]:
    """Return p50, p99, p999 and max of a quantity of which much is bad; empty without samples."""
    if not samples.size:
        return {}
    p50, p99, p999 = np.percentile(samples, (50, 99, 99.9))
    named = {"p50": p50, "p99": p99, "p999": p999, "max": samples.max()}
    return {name: _rounded(float(value)) for name, value in named.items()}


def low_quantiles(samples: NDArray[Any]) -> dict[str, float]:
    """Return p50, p01 (99 % have more), p001 and min of a quantity of which little is bad."""
    if not samples.size:
        return {}
    p50, p01, p001 = np.percentile(samples, (50, 1, 0.1))
    named = {"p50": p50, "p01": p01, "p001": p001, "min": samples.min()}
    return {name: _rounded(float(value)) for name, value in named.items()}


def round_trip_table(tables: Mapping[str, TableReader]) -> TableReader | None:
    """Return the table of the simulation's round trips, else that of the clock's exchanges."""
    own = [t for name, t in tables.items() if name not in FRAMEWORK_TABLES and t.role == "agent"]
    for table in (*own, *(t for name, t in tables.items() if name == "clock")):
        if table.has(ROUND_TRIP):
            return table
    return None


def round_trip_statistics(tables: Mapping[str, TableReader]) -> dict[str, Any]:
    """Return the round trips of all agents in milliseconds, and which stream they come from."""
    table = round_trip_table(tables)
    if table is None:
        return {}
    parts = [columns[ROUND_TRIP] for _, columns in table.each((ROUND_TRIP,))]
    summary = summarise(_joined(parts) / US_PER_MS)
    return {"stream": table.name, **summary.to_mapping()} if summary else {}


def clock_statistics(table: TableReader | None) -> dict[str, float]:
    """Return the largest offset and uncertainty that any agent had, microseconds."""
    names = {"offset_us": "offset_us_max", "uncertainty_us": "uncertainty_us_max"}
    if table is None or not table.has(*names) or not table.rows:
        return {}
    largest: dict[str, float] = {}
    for _, columns in table.each(names):
        for column, name in names.items():
            values = np.abs(columns[column].astype(np.float64))
            if np.isfinite(values).any():
                largest[name] = max(largest.get(name, 0.0), _rounded(float(np.nanmax(values))))
    return largest


@dataclass(frozen=True, slots=True, kw_only=True)
class TickTotals:
    """Ticks of all agents, counted from the records and from the agents' own counters together."""

    due: int
    run: int
    overrun_errors: int

    @property
    def missed(self) -> int:
        """Ticks that were due and did not run."""
        return max(self.due - self.run, 0)

    @property
    def miss_ratio(self) -> float | None:
        """Share of due ticks that did not run; None when none was due."""
        return self.missed / self.due if self.due else None

    @property
    def overrun_ratio(self) -> float | None:
        """Share of due ticks whose step overran the tolerance; None when none was due."""
        return self.overrun_errors / self.due if self.due else None


def tick_totals(
    recorded: Mapping[str, AgentTicks],
    counters: Mapping[str, Mapping[str, Any]],
    *,
    agents: Sequence[str],
    due_each: int | None,
) -> TickTotals:
    """
    Count ticks so that nothing that is missing looks as if it had run.

    Args:
        recorded: By agent, from the records.
        counters: By agent, the `ticks` of its own summary; empty for one that died.
        agents: All agents that should have ticked.
        due_each: Ticks that were due of each by the plan, if the run came to its end. An agent that
            rejoined counts only from then on, and one that died counts nothing.
    """
    due = run = overruns = 0
    for name in agents:
        own, seen = counters.get(name, {}), recorded.get(name)
        seen_run, seen_missed = (seen.run, seen.missed) if seen else (0, 0)
        due += max(int(own.get("due", 0)), due_each or 0, seen_run + seen_missed)
        run += max(int(own.get("run", 0)), seen_run)
        overruns += int(own.get("overrun_errors", 0))
    return TickTotals(due=due, run=run, overrun_errors=overruns)


def _small(values: NDArray[Any]) -> NDArray[Any]:
    """Return microseconds in 4 bytes each: a day at 100 Hz of 93 agents must fit an operator's memory."""
    small: NDArray[Any] = np.clip(values[np.isfinite(values)], -(2**31), 2**31 - 1).astype(np.int32)
    return small


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    return np.concatenate(parts) if parts else np.empty(0)


def _rounded(value: float) -> float:
    """Keep six significant figures of a statistic; counts stay whole."""
    return value if isinstance(value, int) else float(f"{value:.6g}")
