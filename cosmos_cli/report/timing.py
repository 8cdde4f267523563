"""Figures of real time: lateness, margin, missed ticks, and the clock they are measured with."""

from __future__ import annotations

import math

import numpy as np

from cosmos_cli.evidence.datagrams import whole_count
from cosmos_cli.evidence.statistics import TickStatistics, tick_statistics, with_told_misses
from cosmos_cli.evidence.tick_causes import ABSENT, recorded_causes
from cosmos_cli.ui.plural import counted
from madns_runtime.analysis.lines import field_lines
from madns_runtime.analysis.sampling import BinCounts, TimeEnvelope, envelope_series
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Bars,
    Block,
    Figure,
    FigureChoice,
    Floats,
    LimitLine,
    ReportRemark,
    TableBlock,
    headings,
)
from madns_runtime.plain_values import mapping_at

LATENESS_US_MIN = 1.0
HISTOGRAM_BINS = 90
BINS_PER_DECADE = 30
TICK_COUNT = Axis(quantity="ticks", is_logarithmic=True)


def tick_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return lateness over time, the histograms of lateness and margin, missed ticks, and the table."""
    if not table.rows:
        return [ReportRemark(text="No tick was recorded.")]
    ticks = with_told_misses(tick_statistics(table), _told_misses(run))
    return [
        _lateness_over_time(table, run, 1000 * ticks.lateness_ms.get("max", 1.0)),
        _lateness_histogram(table, run),
        _margin_histogram(table, run),
        _missed(ticks),
        _tick_table(ticks),
    ]


def _told_misses(run: RecordedRun) -> dict[str, int]:
    """Return missed ticks by agent: those that late_ticks tells, and by run.json those that nobody told of."""
    told = recorded_causes(run.tables.get("late_ticks"))
    absent = mapping_at(run.document, "timing", "causes_by_agent")
    return {
        name: (told[name].missed if name in told else 0)
        + whole_count(mapping_at(absent, name).get(ABSENT))
        for name in {**absent, **told}
    }


def reached_s(run: RecordedRun) -> float:
    """
    Return the simulated time that a run reached, s, at which figures over it end; 0 where nothing tells.

    Of one whose host was killed no shutdown is on record: its last tick tells.
    """
    end_s = run.end_s if math.isfinite(run.end_s) else 0.0
    ticks = run.tables.get("ticks")
    if run.document.get("status") == "complete" or end_s < run.duration_s or ticks is None:
        return end_s
    times = (run.time_of(ticks, name)[0] for name in ticks.sources)
    return min(end_s, max((float(t_s.max()) for t_s in times if t_s.size), default=end_s))


def clock_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return each agent's estimate of the host's clock over time."""
    blocks: list[Block] = []
    for name, title in (
        ("offset_us", "Offset of the host's clock to the agent's"),
        ("uncertainty_us", "Uncertainty of the offset"),
    ):
        if table.has(name):
            blocks += field_lines(table, run, name, title=f"{title}, µs", y=Axis(unit="µs"))
    return blocks


def _lateness_over_time(table: RecordedTable, run: RecordedRun, worst_us: float) -> Figure:
    times = {name: run.time_of(table, name)[0] for name in table.sources}
    end_s = max((float(t.max()) for t in times.values() if t.size), default=1.0)
    envelope = TimeEnvelope(end_s, LATENESS_US_MIN, worst_us, samples=table.rows)
    for name, t_s in times.items():
        envelope.add(t_s, np.maximum(run.values(table, name, "lateness_us"), LATENESS_US_MIN))
    return Figure(
        title="Lateness of the ticks over time",
        note="Wake-up time minus deadline, of all agents together: median, 99th percentile, largest.",
        y=Axis(unit="µs", is_logarithmic=True),
        choices=[FigureChoice(marks=envelope_series(envelope))],
    )


def _lateness_histogram(table: RecordedTable, run: RecordedRun) -> Figure:
    low_us, high_us = _range(table, run, "lateness_us")
    low_us = max(low_us, LATENESS_US_MIN)
    high_us = max(high_us, 2 * low_us)
    # Lateness is recorded in whole microseconds: narrower bins would only show that.
    bins = int(np.clip(BINS_PER_DECADE * np.log10(high_us / low_us), 10, HISTOGRAM_BINS))
    counts = BinCounts(np.geomspace(low_us, high_us, bins + 1))
    for name in table.sources:
        counts.add(run.values(table, name, "lateness_us"))
    return Figure(
        title="Lateness of all ticks",
        note="Both axes are logarithmic; the leftmost bar also holds what is early or on time.",
        x=Axis(quantity="lateness", unit="µs", is_logarithmic=True),
        y=TICK_COUNT,
        choices=[FigureChoice(marks=[counts.mark()])],
    )


def _margin_histogram(table: RecordedTable, run: RecordedRun) -> Figure:
    low_us, high_us = _range(table, run, "margin_us")
    bins = int(np.clip((high_us - low_us) / 2.0, 10, HISTOGRAM_BINS))
    counts = BinCounts(np.linspace(low_us, max(high_us, low_us + 1.0), bins + 1) / 1000.0)
    for name in table.sources:
        margin_ms = run.values(table, name, "margin_us") / 1000.0
        counts.add(margin_ms[np.isfinite(margin_ms)])
    return Figure(
        title="Margin of all ticks",
        note="Time left when the step ended: right of zero is good.",
        x=Axis(quantity="margin", unit="ms"),
        y=TICK_COUNT,
        choices=[FigureChoice(marks=[counts.mark()])],
        limits=[LimitLine(value=0.0, is_least=True, is_of_x=True)],
    )


def _range(table: RecordedTable, run: RecordedRun, name: str) -> tuple[float, float]:
    low, high = np.inf, -np.inf
    for agent in table.sources:
        values: Floats = run.values(table, agent, name)
        if np.isfinite(values).any():
            low, high = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
    return (low, high) if low <= high else (0.0, 1.0)


def _missed(ticks: TickStatistics) -> Block:
    missed = [agent.missed for agent in ticks.agents.values()]
    if not any(missed):
        return ReportRemark(
            text=f"No tick was skipped between the recorded ones of {counted(len(missed), 'agent')}."
        )
    return Figure(
        title="Missed ticks by agent",
        x=Axis(),
        y=Axis(quantity="ticks"),
        choices=[FigureChoice(marks=[Bars(names=list(ticks.agents), values=missed)])],
    )


def _tick_table(ticks: TickStatistics) -> TableBlock:
    rows = [
        [
            name,
            agent.run,
            agent.missed,
            agent.lateness_ms.get("p50"),
            agent.lateness_ms.get("p99"),
            agent.lateness_ms.get("max"),
            agent.margin_ms.get("min"),
        ]
        for name, agent in ticks.agents.items()
    ]
    return TableBlock(
        title="Ticks by agent",
        headings=headings(
            "agent",
            "run",
            "missed",
            "lateness p50, ms",
            "p99, ms",
            "max, ms",
            "margin min, ms",
        ),
        rows=rows,
    )
