"""Round trips of the counting benchmark: the thesis's figures C.1 to C.11."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from madns_runtime.analysis.distribution import Summary, summarise
from madns_runtime.analysis.lines import generic_blocks, grouped_lines
from madns_runtime.analysis.sampling import TimeEnvelope, envelope_series
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    SIMULATED_TIME,
    Axis,
    Bars,
    Block,
    Figure,
    FigureChoice,
    Floats,
    ReportRemark,
    TableBlock,
    headings,
)
from madns_runtime.plain_values import mapping_at

ROUND_TRIP = "round_trip_us"
LOG_FROM = 20.0
"""Largest over smallest value from which on one late packet would press all others flat on a linear axis."""
COUNTS = {"lost": "lost", "duplicated": "duplicated", "out_of_order": "out of order"}
Times = Mapping[str, tuple[Floats, Floats]]
"""By agent: when each packet was sent, s, and its round trip, ms."""


def round_trip_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return round trips over time, bars of their statistics by agent, and the table."""
    if not table.has(ROUND_TRIP):
        return generic_blocks(table, run)
    if not table.rows:
        return [ReportRemark(text="No packet came back.")]
    times = {name: _read(table, run, name) for name in table.sources}
    by_agent = {
        name: summary for name, (_, values) in times.items() if (summary := summarise(values))
    }
    low_ms = max(min(summary.min for summary in by_agent.values()), 1e-3)
    high_ms = max(summary.max for summary in by_agent.values())
    y = Axis(unit="ms", is_logarithmic=high_ms > LOG_FROM * low_ms)
    return [
        _envelope(times, (low_ms, high_ms), y),
        *grouped_lines(
            times,
            title="Round trips by agent",
            y=y,
            note="Thinned to the smallest and largest of each stretch of time, so no peak is lost.",
        ),
        _bars(run, by_agent),
        _table(run, by_agent),
    ]


def _read(table: RecordedTable, run: RecordedRun, agent: str) -> tuple[Floats, Floats]:
    values_ms = run.values(table, agent, ROUND_TRIP) / 1000.0
    if table.has("packet") and not table.has("t_s") and run.tick_hz:
        return run.values(table, agent, "packet") / run.tick_hz, values_ms
    return run.time_of(table, agent)[0], values_ms


def _envelope(times: Times, range_ms: tuple[float, float], y: Axis) -> Figure:
    end_s = max((float(np.nanmax(t_s)) for t_s, _ in times.values() if t_s.size), default=1.0)
    envelope = TimeEnvelope(end_s, *range_ms, samples=sum(len(t_s) for t_s, _ in times.values()))
    for t_s, values_ms in times.values():
        is_there = np.isfinite(values_ms) & np.isfinite(t_s)
        envelope.add(t_s[is_there], values_ms[is_there])
    return Figure(
        title="Round trips of all agents over time",
        note="Every packet of every agent: median, 99th percentile, largest.",
        x=SIMULATED_TIME,
        y=replace(y, from_zero=not y.is_logarithmic),
        choices=[FigureChoice(marks=envelope_series(envelope))],
    )


def _bars(run: RecordedRun, by_agent: Mapping[str, Summary]) -> Figure:
    summaries = list(by_agent.values())
    quantities: dict[tuple[str, str], list[float | None]] = {
        ("mean", "ms"): [s.mean for s in summaries],
        ("standard deviation", "ms"): [s.sd for s in summaries],
        ("minimum", "ms"): [s.min for s in summaries],
        ("maximum", "ms"): [s.max for s in summaries],
        ("range", "ms"): [s.range for s in summaries],
        ("lost packets", ""): [_count(run, name, "lost") for name in by_agent],
    }
    marks = [
        Bars(names=tuple(by_agent), values=values, panel=panel)
        for panel, values in enumerate(quantities.values())
    ]
    return Figure(
        title="Round trip statistics by agent",
        x=Axis(),
        panels=[Axis(quantity=name, unit=unit) for name, unit in quantities],
        choices=[FigureChoice(marks=marks)],
    )


def _table(run: RecordedRun, by_agent: Mapping[str, Summary]) -> TableBlock:
    rows = [
        [
            name,
            s.count,
            *(round(v, 4) for v in (s.mean, s.sd, s.min, s.max, s.range, s.p99, s.p999)),
            *(_count(run, name, key) for key in COUNTS),
        ]
        for name, s in by_agent.items()
    ]
    return TableBlock(
        title="Round trips by agent, ms",
        headings=headings(
            "agent",
            "packets",
            "mean",
            "sd",
            "min",
            "max",
            "range",
            "p99",
            "p99.9",
            *COUNTS.values(),
        ),
        rows=rows,
        note="Duplicated and out of order are mostly what the link dropped before the simulation saw it;"
        " a packet behind a newer one is lost to it, too.",
    )


def _count(run: RecordedRun, agent: str, key: str) -> int | None:
    value = mapping_at(run.document, "packets", agent).get(key)
    return value if isinstance(value, int) else None
