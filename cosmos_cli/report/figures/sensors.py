"""Figures of sensors: measurement minus truth, where the run recorded both."""

from __future__ import annotations

import numpy as np

from cosmos_cli.measured import SAME_INSTANT_S, TRUTH_TABLES, Quantity, quantities
from cosmos_cli.report.figures.generic import generic_blocks
from cosmos_cli.report.figures.grouped import points_per_trace
from cosmos_cli.report.model import Block, Choice, Figure, Remark, TableBlock, headings
from cosmos_cli.report.sampling import Floats, thin
from cosmos_cli.report.source import Source
from cosmos_cli.report.style import groups_of_agents, layout, line
from cosmos_cli.tables import TableReader

Errors = dict[str, tuple[Floats, Floats]]
"""By agent: time, s, and size of the error."""


def sensor_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return the errors of a sensor over time and a table of them; its values where truth has none."""
    truths = {name: source.tables[name].fields for name in TRUTH_TABLES if name in source.tables}
    blocks: list[Block] = []
    for quantity in quantities(table.name, table.fields, truths):
        errors = {
            agent: found
            for agent in table.sources
            if (found := _errors(table, source, agent, quantity)) is not None
        }
        name = f"{table.name.replace('_', ' ')}, {quantity.title}"
        if errors:
            blocks += [_figure(errors, quantity, name), _table(errors, quantity, name)]
        elif table.rows:
            blocks.append(Remark(text=f"{name}: truth was recorded at no measurement's time."))
    return blocks or generic_blocks(table, source)


def _errors(
    table: TableReader, source: Source, agent: str, quantity: Quantity
) -> tuple[Floats, Floats] | None:
    truth = source.tables[quantity.truth]
    if agent not in truth.sources:
        return None
    measured_s, _ = source.time_of(table, agent)
    truth_s, _ = source.time_of(truth, agent)
    if not len(measured_s) or not len(truth_s):
        return None
    order = np.argsort(truth_s, kind="stable")
    place = np.clip(np.searchsorted(truth_s[order], measured_s), 0, len(order) - 1)
    before = np.maximum(place - 1, 0)
    closer = np.abs(truth_s[order][before] - measured_s) < np.abs(
        truth_s[order][place] - measured_s
    )
    partner = order[np.where(closer, before, place)]
    is_there = np.abs(truth_s[partner] - measured_s) <= SAME_INSTANT_S
    if not is_there.any():
        return None
    columns = table.read(agent, quantity.names)
    of_truth = truth.read(agent, quantity.names)
    sizes = quantity.sizes(
        {name: values[is_there] for name, values in columns.items()},
        {name: values[partner[is_there]] for name, values in of_truth.items()},
    )
    return measured_s[is_there], sizes


def _figure(errors: Errors, quantity: Quantity, name: str) -> Figure:
    points = points_per_trace(len(errors))
    choices = []
    for label, group in groups_of_agents(tuple(errors)):
        traces = []
        for index, agent in enumerate(group):
            x, y = thin(*errors[agent], points)
            traces.append(line(x, y, agent, index, opacity=0.85))
        choices.append(Choice(name=label, traces=traces))
    figure_layout = layout("valid at simulated time, s", quantity.unit, showlegend=True)
    figure_layout["yaxis"] |= {"rangemode": "tozero"}
    return Figure(
        title=f"Error of {name}",
        note="Size of measurement minus truth, at the time for which the measurement was valid.",
        choices=choices,
        layout=figure_layout,
        group="agents",
    )


def _table(errors: Errors, quantity: Quantity, name: str) -> TableBlock:
    rows: list[list[object]] = []
    for agent, (_, sizes) in errors.items():
        sizes = sizes[np.isfinite(sizes)]  # noqa: PLW2901 - what of them is a number
        if len(sizes):
            rms = float(np.sqrt(np.mean(sizes * sizes)))
            rows.append([agent, len(sizes), rms, float(np.median(sizes)), float(sizes.max())])
    return TableBlock(
        title=f"Error of {name}, {quantity.unit}",
        headings=headings("agent", "measurements", "rms", "median", "max"),
        rows=rows,
    )
