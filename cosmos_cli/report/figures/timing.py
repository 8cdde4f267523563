"""Figures of real time: lateness, margin, missed ticks, and the clock they are measured with."""

from __future__ import annotations

import numpy as np

from cosmos_cli.counted import counted
from cosmos_cli.report.figures.grouped import grouped_lines
from cosmos_cli.report.model import Block, Choice, Figure, Remark, TableBlock, Trace, headings
from cosmos_cli.report.sampling import Floats, Histogram, TimeEnvelope
from cosmos_cli.report.source import Source
from cosmos_cli.report.style import ACCENT, BAD, bars, envelope_lines, layout, log_axis
from cosmos_cli.tables import TableReader

LATENESS_US_MIN = 1.0
HISTOGRAM_BINS = 90
BINS_PER_DECADE = 30
TICKS_TOLD_MAX = 6
"""Whole numbers up to this one each have a line: there is no half a tick."""


def tick_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return lateness over time, the histograms of lateness and margin, missed ticks, and the table."""
    if not table.rows:
        return [Remark(text="No tick was recorded.")]
    return [
        _lateness_over_time(table, source),
        _lateness_histogram(table, source),
        _margin_histogram(table, source),
        _missed(source),
        _tick_table(source),
    ]


def clock_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return each agent's estimate of the host's clock over time."""
    blocks: list[Block] = []
    for name, title in (
        ("offset_us", "Offset of the host's clock to the agent's"),
        ("uncertainty_us", "Uncertainty of the offset"),
    ):
        if table.has(name):
            blocks.extend(grouped_lines(table, source, name, title=f"{title}, µs", unit="µs"))
    return blocks


def _lateness_over_time(table: TableReader, source: Source) -> Figure:
    worst_us = 1000 * source.ticks.lateness_ms.get("max", 1.0)
    times = {name: source.time_of(table, name)[0] for name in table.sources}
    end_s = max((float(t.max()) for t in times.values() if t.size), default=1.0)
    envelope = TimeEnvelope(end_s, LATENESS_US_MIN, worst_us, samples=table.rows)
    for name, t_s in times.items():
        envelope.add(t_s, np.maximum(source.values(table, name, "lateness_us"), LATENESS_US_MIN))
    middles, curves = envelope.curves()
    figure_layout = layout("simulated time, s", "µs")
    figure_layout["yaxis"] |= log_axis(float(curves["p50"].min()), worst_us)
    return Figure(
        title="Lateness of the ticks over time",
        note="Wake-up time minus deadline, of all agents together: median, 99th percentile, largest.",
        choices=[Choice(name="", traces=envelope_lines(middles, curves))],
        layout=figure_layout,
    )


def _lateness_histogram(table: TableReader, source: Source) -> Figure:
    low_us, high_us = _range(table, source, "lateness_us")
    low_us = max(low_us, LATENESS_US_MIN)
    high_us = max(high_us, 2 * low_us)
    # Lateness is recorded in whole microseconds: narrower bins would only show that.
    bins = int(np.clip(BINS_PER_DECADE * np.log10(high_us / low_us), 10, HISTOGRAM_BINS))
    histogram = Histogram(np.geomspace(low_us, high_us, bins + 1))
    for name in table.sources:
        histogram.add(source.values(table, name, "lateness_us"))
    figure_layout = layout("lateness, µs", "ticks", bargap=0.05)
    figure_layout["xaxis"] |= log_axis(low_us, high_us)
    figure_layout["yaxis"] |= log_axis(1, float(histogram.counts.max()))
    return Figure(
        title="Lateness of all ticks",
        note="Both axes are logarithmic; the leftmost bar also holds what is early or on time.",
        choices=[Choice(name="", traces=[_histogram_trace(histogram, "µs")])],
        layout=figure_layout,
    )


def _margin_histogram(table: TableReader, source: Source) -> Figure:
    low_us, high_us = _range(table, source, "margin_us")
    bins = int(np.clip((high_us - low_us) / 2.0, 10, HISTOGRAM_BINS))
    edges = np.linspace(low_us, max(high_us, low_us + 1.0), bins + 1) / 1000.0
    histogram = Histogram(edges)
    for name in table.sources:
        margin_ms = source.values(table, name, "margin_us") / 1000.0
        histogram.add(margin_ms[np.isfinite(margin_ms)])
    trace = _histogram_trace(histogram, "ms")
    trace["marker"] = {"color": [BAD if middle < 0 else ACCENT for middle in histogram.middles]}
    figure_layout = layout("margin, ms", "ticks", bargap=0.05)
    figure_layout["yaxis"] |= log_axis(1, float(histogram.counts.max()))
    return Figure(
        title="Margin of all ticks",
        note="Time left when the step ended: right of zero is good.",
        choices=[Choice(name="", traces=[trace])],
        layout=figure_layout,
    )


def _histogram_trace(histogram: Histogram, unit: str) -> Trace:
    return {
        "type": "bar",
        "x": histogram.middles,
        "y": histogram.counts.astype(np.float64),
        "width": np.diff(histogram.edges),
        "marker": {"color": ACCENT},
        "showlegend": False,
        "hovertemplate": f"%{{x:.3g}} {unit}: %{{y:.0f}} ticks<extra></extra>",
    }


def _range(table: TableReader, source: Source, name: str) -> tuple[float, float]:
    low, high = np.inf, -np.inf
    for agent in table.sources:
        values: Floats = source.values(table, agent, name)
        if np.isfinite(values).any():
            low, high = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
    return (low, high) if low <= high else (0.0, 1.0)


def _missed(source: Source) -> Block:
    agents = source.ticks.agents
    missed = [agent.missed for agent in agents.values()]
    if not any(missed):
        return Remark(
            text=f"No tick was skipped between the recorded ones of {counted(len(agents), 'agent')}."
        )
    figure_layout = layout("", "ticks")
    figure_layout["xaxis"] |= {"type": "category", "tickangle": -90}
    if max(missed) <= TICKS_TOLD_MAX:
        figure_layout["yaxis"] |= {"dtick": 1}
    return Figure(
        title="Missed ticks by agent",
        choices=[Choice(name="", traces=[bars(list(agents), missed)])],
        layout=figure_layout,
        height_px=240,
    )


def _tick_table(source: Source) -> TableBlock:
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
        for name, agent in source.ticks.agents.items()
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
