"""
Figures of a run from all its samples: ticks, lateness, margin, round trips, clock, and the sources of the worst values.

Reads tables, writes nothing. A check over many holds one number; a person who is to mend something needs to know
where it came from.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cosmos_cli.evidence.completeness import is_excused
from cosmos_cli.evidence.datagrams import whole_count
from cosmos_cli.evidence.streams import StreamScan
from madns_runtime.analysis.distribution import Distribution, Summary, rounded
from madns_runtime.analysis.tables import RecordedTable, Tables
from madns_runtime.plain_values import mapping_at
from madns_runtime.protocol.messages import SERVICE_NAMES

US_PER_MS = 1000.0
LOST = "lost"
"""State of an agent that did not come to the run's end, as the host tells it."""
ROUND_TRIP = "round_trip_us"
CLOCK_ROUND_TRIP = "round_trip_us_min"
CLOCK_ROUND_TRIP_STREAM = "clock (minimum a window)"
CLOCK_ROUND_TRIP_NAMES = ("count", "min", "p50", "max")
"""Each is the quickest exchange of a window: it says nothing of the mean, nor of the tail."""
FRAMEWORK_TABLES = ("ticks", "late_ticks", "clock", "events", "log", "process")


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentTicks:
    """One agent's ticks, all incarnations together."""

    run: int
    missed: int
    lateness_ms: Mapping[str, float]
    margin_ms: Mapping[str, float]
    overrun_errors: int = 0
    """Steps that ended later than is tolerated, as far as whole microseconds tell."""


NO_TICKS = AgentTicks(run=0, missed=0, lateness_ms={}, margin_ms={})


@dataclass(frozen=True, slots=True, kw_only=True)
class TickStatistics:
    """Every recorded tick of a run."""

    agents: Mapping[str, AgentTicks]
    lateness_ms: Mapping[str, float]
    margin_ms: Mapping[str, float]


def tick_statistics(table: RecordedTable | None, overrun_ms: float | None = None) -> TickStatistics:
    """
    Return lateness and margin over all ticks of all agents, and by agent.

    Args:
        table: Of the ticks.
        overrun_ms: Overrun that is tolerated; None if it is not known.
    """
    limit_us = -math.inf if overrun_ms is None else -overrun_ms * US_PER_MS
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
                overrun_errors=int(np.count_nonzero(columns["margin_us"] < limit_us)),
            )
    return TickStatistics(agents=agents, lateness_ms=_high_ms(lateness), margin_ms=_low_ms(margin))


def round_trip_table(tables: Tables) -> RecordedTable | None:
    """Return the table of the simulation's round trips, numbers in microseconds; None if it records none."""
    own = [t for name, t in tables.items() if name not in FRAMEWORK_TABLES and t.role == "agent"]
    return next((table for table in own if _holds_round_trips(table)), None)


def _holds_round_trips(table: RecordedTable) -> bool:
    field = next((field for field in table.fields if field.name == ROUND_TRIP), None)
    return field is not None and field.unit == "us" and field.kind in ("int", "float")


def round_trip_statistics(tables: Tables) -> dict[str, Any]:
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


def _all_of(table: RecordedTable, column: str) -> Summary | None:
    distribution = Distribution()
    for _, columns in table.each((column,)):
        distribution.add(Distribution.of(columns[column]))
    return distribution.summary(1 / US_PER_MS)


def clock_statistics(table: RecordedTable | None) -> dict[str, float]:
    """Return the largest offset and uncertainty that any agent had, microseconds."""
    names = {"offset_us": "offset_us_max", "uncertainty_us": "uncertainty_us_max"}
    if table is None or not table.has(*names) or not table.rows:
        return {}
    largest: dict[str, float] = {}
    for _, columns in table.each(names):
        for column, name in names.items():
            values = np.abs(columns[column].astype(np.float64))
            if np.isfinite(values).any():
                largest[name] = max(largest.get(name, 0.0), rounded(float(np.nanmax(values))))
    return largest


@dataclass(frozen=True, slots=True, kw_only=True)
class TickTotals:
    """Ticks of all agents, counted from the records and from the agents' own counters together."""

    due: int
    run: int
    overrun_errors: int
    agents: Mapping[str, TickTotals] = field(default_factory=dict)
    """Each agent's own, where these are of all."""

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


def with_told_misses(found: TickStatistics, told: Mapping[str, int]) -> TickStatistics:
    """
    Return statistics with the missed ticks that no other followed, too.

    By agent, others than its ticks *told* them: of one that never ran a tick they are all there is.
    """
    known = dict.fromkeys(told, NO_TICKS) | dict(found.agents)
    agents = {
        name: replace(of, missed=max(of.missed, told.get(name, 0)))
        for name, of in sorted(known.items())
    }
    return replace(found, agents=agents)


def tick_totals(
    recorded: Mapping[str, AgentTicks],
    counters: Mapping[str, Mapping[str, Any]],
    *,
    agents: Sequence[str],
    due_each: int | None,
    excused: Collection[str] = (),
) -> TickTotals:
    """
    Count ticks so that nothing that is missing looks as if it had run.

    Args:
        recorded: By agent, from the records.
        counters: By agent, the `ticks` of its own summary; empty for one that died.
        agents: All agents that should have ticked.
        due_each: Ticks that were due of each by the plan, if the run came to its end. An agent that
            rejoined counts only from then on, and one that died counts nothing.
        excused: Agents that were away on purpose, and for no other reason: nothing was due of them then.
    """
    totals: dict[str, TickTotals] = {}
    for name in agents:
        own, seen = counters.get(name, {}), recorded.get(name)
        seen_run, seen_missed = (seen.run, seen.missed) if seen else (0, 0)
        # A summary is of the last incarnation alone; records are of all.
        seen_overruns = seen.overrun_errors if seen else 0
        totals[name] = TickTotals(
            due=max(_due(own, due_each, is_excused=name in excused), seen_run + seen_missed),
            run=max(whole_count(own.get("run")), seen_run),
            overrun_errors=max(whole_count(own.get("overrun_errors")), seen_overruns),
        )
    return TickTotals(
        due=sum(of.due for of in totals.values()),
        run=sum(of.run for of in totals.values()),
        overrun_errors=sum(of.overrun_errors for of in totals.values()),
        agents=totals,
    )


def _due(own: Mapping[str, Any], due_each: int | None, *, is_excused: bool) -> int:
    """Return the ticks that were due of an agent by its own summary and the plan; of one excused, while it was there."""
    if is_excused:
        return whole_count(own.get("run")) + whole_count(own.get("missed"))
    return max(whole_count(own.get("due")), due_each or 0)


def _high_ms(samples_us: Distribution) -> dict[str, float]:
    summary = samples_us.summary(1 / US_PER_MS)
    return summary.high() if summary else {}


def _low_ms(samples_us: Distribution) -> dict[str, float]:
    summary = samples_us.summary(1 / US_PER_MS)
    return summary.low() if summary else {}


def worst_sources(
    ticks: Mapping[str, TickTotals], agents: Mapping[str, Any], scans: Sequence[StreamScan]
) -> dict[str, str]:
    """
    Return by name of a check of the framework whose value is the worst, where one's is.

    Args:
        ticks: By agent.
        agents: What the host told of each agent, by name.
        scans: Of all streams.
    """
    judged = [scan for scan in scans if not is_excused(scan, agents)]
    found = {
        "deadline.miss_ratio": _largest((name, of.miss_ratio) for name, of in ticks.items()),
        "deadline.overrun_ratio": _largest((name, of.overrun_ratio) for name, of in ticks.items()),
        "records.dropped": _largest((scan.file.label, scan.dropped) for scan in judged),
        "records.truncated": _largest((scan.file.label, int(scan.truncated)) for scan in judged),
        "records.not_finite": _largest((scan.file.label, scan.not_finite) for scan in scans),
    }
    counts = {name: mapping_at(agents, name, "messages") for name in agents}
    # What was on its way to and from agents that are lost is in no sum of lost messages.
    stayed = {
        name: of for name, of in counts.items() if mapping_at(agents, name).get("state") != LOST
    }
    for service in SERVICE_NAMES:
        for what, among in (("lost", stayed), ("deadlines_broken", counts)):
            told = ((name, mapping_at(of, service).get(what)) for name, of in among.items())
            found[f"messages.{service}.{what}"] = _largest(told)
    return {name: who for name, who in found.items() if who is not None}


def _largest(values: Iterable[tuple[str, Any]]) -> str | None:
    """Return the first name with the largest value above 0, and how many others have the same; None without."""
    above = [
        (name, value) for name, value in values if isinstance(value, int | float) and value > 0
    ]
    if not above:
        return None
    largest = max(value for _, value in above)
    first, *others = [name for name, value in above if value == largest]
    return f"{first} and {len(others)} more" if others else first
