"""Round trips of the counting benchmark: the thesis's figures C.1 to C.11."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from cosmos_cli.report.figures.generic import generic_blocks
from cosmos_cli.report.figures.grouped import grouped_lines
from cosmos_cli.report.model import Block, Choice, Figure, Remark, TableBlock, headings
from cosmos_cli.report.sampling import TimeEnvelope
from cosmos_cli.report.source import Source
from cosmos_cli.report.style import bar_grid, envelope_lines, layout, log_axis
from cosmos_cli.statistics import ROUND_TRIP, Summary, summarise
from cosmos_cli.tables import TableReader

LOG_FROM = 20.0
COUNTS = {"lost": "lost", "duplicated": "duplicated", "out_of_order": "out of order"}


def round_trip_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return round trips over time, bars of their statistics by agent, and the table."""
    if not table.has(ROUND_TRIP):
        return generic_blocks(table, source)
    if not table.rows:
        return [Remark(text="No packet came back.")]
    by_agent = {
        name: summary
        for name in table.sources
        if (summary := summarise(source.values(table, name, ROUND_TRIP) / 1000.0))
    }
    time_series: list[Block] = [
        _envelope(table, source, by_agent),
        *grouped_lines(
            table,
            source,
            ROUND_TRIP,
            title="Round trips by agent",
            unit="ms",
            note="Thinned to the smallest and largest of each stretch of time, so no peak is lost.",
            scale=1e-3,
        ),
    ]
    low_ms = max(min(summary.min for summary in by_agent.values()), 1e-3)
    high_ms = max(summary.max for summary in by_agent.values())
    if high_ms > LOG_FROM * low_ms:
        # One late packet would press all others flat on a linear axis.
        time_series = [_logarithmic(block, low_ms, high_ms) for block in time_series]
    return [*time_series, _bars(source, by_agent), _table(source, by_agent)]


def _logarithmic(block: Block, low: float, high: float) -> Block:
    if not isinstance(block, Figure):
        return block
    y_axis = {**block.layout["yaxis"], **log_axis(low, high)}
    return dataclasses.replace(block, layout={**block.layout, "yaxis": y_axis})


def _envelope(table: TableReader, source: Source, by_agent: Mapping[str, Summary]) -> Figure:
    low_ms = max(min(summary.min for summary in by_agent.values()), 1e-3)
    high_ms = max(summary.max for summary in by_agent.values())
    times = {name: source.time_of(table, name) for name in table.sources}
    end_s = max((float(np.nanmax(t)) for t, _ in times.values() if t.size), default=1.0)
    envelope = TimeEnvelope(end_s, low_ms, high_ms, samples=table.rows)
    for name, (t_s, _) in times.items():
        values_ms = source.values(table, name, ROUND_TRIP) / 1000.0
        is_there = np.isfinite(values_ms) & np.isfinite(t_s)
        envelope.add(t_s[is_there], values_ms[is_there])
    middles, curves = envelope.curves()
    figure_layout = layout(next(iter(times.values()))[1], "ms")
    figure_layout["yaxis"] |= {"rangemode": "tozero"}
    return Figure(
        title="Round trips of all agents over time",
        note="Every packet of every agent: median, 99th percentile, largest.",
        choices=[Choice(name="", traces=envelope_lines(middles, curves))],
        layout=figure_layout,
    )


def _bars(source: Source, by_agent: Mapping[str, Summary]) -> Figure:
    summaries = list(by_agent.values())
    quantities: dict[str, list[float | None]] = {
        "mean, ms": [s.mean for s in summaries],
        "standard deviation, ms": [s.sd for s in summaries],
        "minimum, ms": [s.min for s in summaries],
        "maximum, ms": [s.max for s in summaries],
        "range, ms": [s.range for s in summaries],
        "lost packets": [_count(source, name, "lost") for name in by_agent],
    }
    traces, figure_layout, height_px = bar_grid(tuple(by_agent), quantities)
    return Figure(
        title="Round trip statistics by agent",
        choices=[Choice(name="", traces=traces)],
        layout=figure_layout,
        height_px=height_px,
    )


def _table(source: Source, by_agent: Mapping[str, Summary]) -> TableBlock:
    rows = [
        [
            name,
            s.count,
            *(round(v, 4) for v in (s.mean, s.sd, s.min, s.max, s.range, s.p99, s.p999)),
            *(_count(source, name, key) for key in COUNTS),
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


def _count(source: Source, agent: str, key: str) -> int | None:
    value = source.packet_counts(agent).get(key)
    return value if isinstance(value, int) else None
