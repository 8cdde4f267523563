"""Figures of a run from all its samples: ticks, lateness, margin, round trips, clock. Reads tables, writes nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.tables import TableReader

Floats = NDArray[np.float64]
US_PER_MS = 1000.0
QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "p01": 0.01, "p001": 0.001}
SUMMARY_NAMES = ("count", "mean", "sd", "min", "max", "p50", "p99", "p999")
ROUND_TRIP = "round_trip_us"
CLOCK_ROUND_TRIP = "round_trip_us_min"
CLOCK_ROUND_TRIP_STREAM = "clock (minimum a window)"
CLOCK_ROUND_TRIP_NAMES = ("count", "min", "p50", "max")
"""Each is the quickest exchange of a window: it says nothing of the mean, nor of the tail."""
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
    p01: float
    p001: float

    @property
    def range(self) -> float:
        """Largest minus smallest."""
        return self.max - self.min

    def to_mapping(self) -> dict[str, float]:
        """Return the statistics as run.json holds them."""
        return {name: _rounded(getattr(self, name)) for name in (*SUMMARY_NAMES, "range")}

    def high(self) -> dict[str, float]:
        """Return p50, p99, p999 and max: of a quantity of which much is bad."""
        return {name: _rounded(getattr(self, name)) for name in ("p50", "p99", "p999", "max")}

    def low(self) -> dict[str, float]:
        """Return p50, p01 (99 % have more), p001 and min: of a quantity of which little is bad."""
        return {name: _rounded(getattr(self, name)) for name in ("p50", "p01", "p001", "min")}


class Distribution:
    """
    Every sample of a quantity, kept as the values that occur and how often each does.

    Exact, as if all samples were kept side by side; but whole microseconds of a day at 100 Hz of 93
    agents are a few thousand values and not six gigabytes.
    """

    def __init__(self) -> None:
        self._values: Floats = np.empty(0)
        self._counts: NDArray[np.int64] = np.empty(0, dtype=np.int64)

    @classmethod
    def of(cls, samples: NDArray[Any]) -> Distribution:
        """Return the distribution of samples, shape (N,); what is not finite is left out."""
        finite = samples if samples.dtype.kind in "iu" else samples[np.isfinite(samples)]
        values, counts = np.unique(finite, return_counts=True)
        made = cls()
        made._values, made._counts = values.astype(np.float64), counts
        return made

    def add(self, other: Distribution) -> None:
        """Take the samples of another distribution as well."""
        merged = np.concatenate((self._values, other._values))
        self._values, place = np.unique(merged, return_inverse=True)
        weights = np.concatenate((self._counts, other._counts))
        self._counts = np.bincount(place, weights, len(self._values)).astype(np.int64)

    def summary(self, scale: float = 1.0) -> Summary | None:
        """
        Return the statistics of all samples; None if there are none.

        Args:
            scale: Factor on the values, positive.
        """
        count = int(self._counts.sum())
        if not count:
            return None
        values = self._values * scale
        mean = float((values * self._counts).sum() / count)
        variance = float((self._counts * (values - mean) ** 2).sum() / count)
        quantiles = {name: self._quantile(q) * scale for name, q in QUANTILES.items()}
        return Summary(
            count=count,
            mean=mean,
            sd=math.sqrt(variance),
            min=float(values[0]),
            max=float(values[-1]),
            **quantiles,
        )

    def _quantile(self, quantile: float) -> float:
        """Return a quantile as numpy's default does: linear between the two nearest samples."""
        cumulated = np.cumsum(self._counts)
        position = quantile * (int(cumulated[-1]) - 1)
        low = math.floor(position)
        lower, upper = np.searchsorted(cumulated, (low, math.ceil(position)), "right")
        below, above = self._values[lower], self._values[upper]
        return float(below + (position - low) * (above - below))


def summarise(samples: NDArray[Any]) -> Summary | None:
    """Return the statistics of all finite samples, shape (N,); None if there are none."""
    return Distribution.of(samples).summary()


@dataclass(frozen=True, slots=True, kw_only=True)
class TickStatistics:
    """Every recorded tick of a run."""

    agents: Mapping[str, AgentTicks]
    lateness_ms: Mapping[str, float]
    margin_ms: Mapping[str, float]


def tick_statistics(table: TableReader | None) -> TickStatistics:
    """Return lateness and margin over all ticks of all agents, and by agent."""
    agents: dict[str, AgentTicks] = {}
    lateness, margin = Distribution(), Distribution()
    if table is not None and table.has("lateness_us", "margin_us", "missed"):
        for name, columns in table.each(("lateness_us", "margin_us", "missed")):
            late = Distribution.of(columns["lateness_us"])
            left = Distribution.of(columns["margin_us"])
            lateness.add(late)
            margin.add(left)
            agents[name] = AgentTicks(
                run=len(columns["missed"]),
                missed=int(np.nansum(columns["missed"])),
                lateness_ms=_high_ms(late),
                margin_ms=_low_ms(left),
            )
    return TickStatistics(agents=agents, lateness_ms=_high_ms(lateness), margin_ms=_low_ms(margin))


def round_trip_table(tables: Mapping[str, TableReader]) -> TableReader | None:
    """Return the table of the simulation's round trips; None if it records none."""
    own = [t for name, t in tables.items() if name not in FRAMEWORK_TABLES and t.role == "agent"]
    return next((table for table in own if table.has(ROUND_TRIP)), None)


def round_trip_statistics(tables: Mapping[str, TableReader]) -> dict[str, Any]:
    """Return the round trips of all agents in milliseconds, and which stream they come from."""
    table = round_trip_table(tables)
    if table is not None:
        summary = _all_of(table, ROUND_TRIP)
        return {"stream": table.name, **summary.to_mapping()} if summary else {}
    clock = tables.get("clock")
    summary = _all_of(clock, CLOCK_ROUND_TRIP) if clock and clock.has(CLOCK_ROUND_TRIP) else None
    if summary is None:
        return {}
    figures = summary.to_mapping()
    return {
        "stream": CLOCK_ROUND_TRIP_STREAM,
        **{name: figures[name] for name in CLOCK_ROUND_TRIP_NAMES},
    }


def _all_of(table: TableReader, column: str) -> Summary | None:
    distribution = Distribution()
    for _, columns in table.each((column,)):
        distribution.add(Distribution.of(columns[column]))
    return distribution.summary(1 / US_PER_MS)


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


def _high_ms(samples_us: Distribution) -> dict[str, float]:
    summary = samples_us.summary(1 / US_PER_MS)
    return summary.high() if summary else {}


def _low_ms(samples_us: Distribution) -> dict[str, float]:
    summary = samples_us.summary(1 / US_PER_MS)
    return summary.low() if summary else {}


def _rounded(value: float) -> float:
    """Keep six significant figures of a statistic; counts stay whole."""
    return value if isinstance(value, int) else float(f"{value:.6g}")
