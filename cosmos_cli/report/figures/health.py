"""State of health: processors, temperature, memory of the machines, and what the agents' processes use."""

from __future__ import annotations

import numpy as np

from cosmos_cli.report.figures.grouped import grouped_lines
from cosmos_cli.report.model import Block, Choice, Figure, Remark, TableBlock, headings
from cosmos_cli.report.source import Source
from cosmos_cli.report.style import bar_grid
from cosmos_cli.statistics import Summary, summarise
from cosmos_cli.tables import TableReader

CPU, TEMPERATURE = "cpu_percent", "core_temperature_c"
BYTES_PER_MB = 1e6
BARS_FROM = 2
"""One machine's bars would say no more than the table."""


def health_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return CPU and temperature of each machine over time, their statistics, and what else weighs."""
    blocks: list[Block] = [
        *_quantity(table, source, CPU, f"CPU usage {_whose(table)}", "%"),
        *_temperature(table, source),
    ]
    if table.has("ram_percent"):
        blocks += grouped_lines(
            table, source, "ram_percent", title="Memory in use", unit="%", from_zero=True
        )
    if table.has("load_1min"):
        blocks += grouped_lines(
            table, source, "load_1min", title="Load, 1 min mean", unit="", from_zero=True
        )
    return blocks


def _whose(table: TableReader) -> str:
    return "of the host's machine" if table.role == "host" else "by machine"


def process_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return CPU and memory of the agents' processes."""
    blocks = _quantity(
        table,
        source,
        CPU,
        "CPU usage by agent",
        "%",
        note="Of the process that runs the agent; agents that share a process share its figure.",
    )
    if table.has("rss_bytes"):
        blocks += grouped_lines(
            table,
            source,
            "rss_bytes",
            title="Resident memory",
            unit="MB",
            scale=1 / BYTES_PER_MB,
            from_zero=True,
        )
    return blocks


def _temperature(table: TableReader, source: Source) -> list[Block]:
    if not table.has(TEMPERATURE):
        return []
    without = [
        name
        for name in table.sources
        if not np.isfinite(source.values(table, name, TEMPERATURE)).any()
    ]
    blocks: list[Block] = []
    if len(without) < len(table.sources):
        blocks += _quantity(table, source, TEMPERATURE, f"Core temperature {_whose(table)}", "°C")
    if without:
        shown = ", ".join(without[:8]) + (
            f" and {len(without) - 8} more" if len(without) > 8 else ""
        )
        verb = "has" if len(without) == 1 else "have"
        blocks.append(Remark(text=f"{shown} {verb} no temperature sensor: nothing to draw."))
    return blocks


def _quantity(  # noqa: PLR0913 - what is drawn and how it is lettered
    table: TableReader, source: Source, name: str, title: str, unit: str, *, note: str = ""
) -> list[Block]:
    if not table.has(name):
        return []
    summaries = {
        who: summary
        for who in table.sources
        if (summary := summarise(source.values(table, who, name)))
    }
    blocks = grouped_lines(
        table, source, name, title=title, unit=unit, note=note, from_zero=name == CPU
    )
    if len(summaries) >= BARS_FROM:
        blocks.append(_bars(summaries, f"{title}: maximum, minimum, mean, deviation", unit))
    if summaries:
        blocks.append(_table(summaries, f"{title}, {unit}", table.role))
    return blocks


def _bars(summaries: dict[str, Summary], title: str, unit: str) -> Figure:
    values = list(summaries.values())
    quantities: dict[str, list[float | None]] = {
        f"maximum, {unit}": [s.max for s in values],
        f"minimum, {unit}": [s.min for s in values],
        f"mean, {unit}": [s.mean for s in values],
        f"standard deviation, {unit}": [s.sd for s in values],
    }
    traces, figure_layout, height_px = bar_grid(tuple(summaries), quantities)
    return Figure(
        title=title,
        choices=[Choice(name="", traces=traces)],
        layout=figure_layout,
        height_px=height_px,
    )


def _table(summaries: dict[str, Summary], title: str, who: str) -> TableBlock:
    rows = [[name, s.count, s.mean, s.sd, s.min, s.max] for name, s in summaries.items()]
    return TableBlock(
        title=title, headings=headings(who, "samples", "mean", "sd", "min", "max"), rows=rows
    )
