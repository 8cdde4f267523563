"""State of health: processors, temperature, memory of the machines, and what the agents' processes use."""

from __future__ import annotations

import numpy as np

from madns_runtime.analysis.distribution import Summary, summarise
from madns_runtime.analysis.lines import field_lines
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Bars,
    Block,
    Figure,
    FigureChoice,
    ReportRemark,
    TableBlock,
    headings,
)
from madns_runtime.plain_values import first_few

CPU, TEMPERATURE = "cpu_percent", "core_temperature_c"
BYTES_PER_MB = 1e6
BARS_FROM = 2
"""One machine's bars would say no more than the table."""


def health_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return CPU and temperature of each machine over time, their statistics, and what else weighs."""
    blocks: list[Block] = [
        *_quantity(table, run, CPU, f"CPU usage {_whose(table)}", "%"),
        *_temperature(table, run),
    ]
    if table.has("ram_percent"):
        blocks += field_lines(
            table, run, "ram_percent", title="Memory in use", y=Axis(unit="%", from_zero=True)
        )
    if table.has("load_1min"):
        blocks += field_lines(
            table, run, "load_1min", title="Load, 1 min mean", y=Axis(from_zero=True)
        )
    return blocks


def _whose(table: RecordedTable) -> str:
    return "of the host's machine" if table.role == "host" else "by machine"


def process_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return CPU and memory of the agents' processes."""
    blocks = _quantity(
        table,
        run,
        CPU,
        "CPU usage by agent",
        "%",
        note="Of the process that runs the agent; agents that share a process share its figure.",
    )
    if table.has("rss_bytes"):
        blocks += field_lines(
            table,
            run,
            "rss_bytes",
            title="Resident memory",
            y=Axis(unit="MB", from_zero=True),
            scale=1 / BYTES_PER_MB,
        )
    return blocks


def _temperature(table: RecordedTable, run: RecordedRun) -> list[Block]:
    if not table.has(TEMPERATURE):
        return []
    without = [
        name
        for name in table.sources
        if not np.isfinite(run.values(table, name, TEMPERATURE)).any()
    ]
    blocks: list[Block] = []
    if len(without) < len(table.sources):
        blocks += _quantity(table, run, TEMPERATURE, f"Core temperature {_whose(table)}", "°C")
    if without:
        verb = "has" if len(without) == 1 else "have"
        blocks.append(
            ReportRemark(
                text=f"{first_few(without, 8)} {verb} no temperature sensor: nothing to draw."
            )
        )
    return blocks


def _quantity(  # noqa: PLR0913 - what is drawn and how it is lettered
    table: RecordedTable, run: RecordedRun, name: str, title: str, unit: str, *, note: str = ""
) -> list[Block]:
    if not table.has(name):
        return []
    summaries = {
        who: summary
        for who in table.sources
        if (summary := summarise(run.values(table, who, name)))
    }
    y = Axis(unit=unit, from_zero=name == CPU)
    blocks = field_lines(table, run, name, title=title, y=y, note=note)
    if len(summaries) >= BARS_FROM:
        blocks.append(_bars(summaries, f"{title}: maximum, minimum, mean, deviation", unit))
    if summaries:
        blocks.append(_table(summaries, f"{title}, {unit}", table.role))
    return blocks


def _bars(summaries: dict[str, Summary], title: str, unit: str) -> Figure:
    values = list(summaries.values())
    quantities: dict[str, list[float | None]] = {
        "maximum": [s.max for s in values],
        "minimum": [s.min for s in values],
        "mean": [s.mean for s in values],
        "standard deviation": [s.sd for s in values],
    }
    marks = [
        Bars(names=tuple(summaries), values=values, panel=panel)
        for panel, values in enumerate(quantities.values())
    ]
    return Figure(
        title=title,
        x=Axis(),
        panels=[Axis(quantity=quantity, unit=unit) for quantity in quantities],
        choices=[FigureChoice(marks=marks)],
    )


def _table(summaries: dict[str, Summary], title: str, who: str) -> TableBlock:
    return TableBlock(
        title=title,
        headings=headings(who, "samples", "mean", "sd", "min", "max"),
        rows=[[name, s.count, s.mean, s.sd, s.min, s.max] for name, s in summaries.items()],
    )
