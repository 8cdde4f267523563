"""Time series of many agents: drawn in groups of five that a reader chooses between."""

from __future__ import annotations

import numpy as np

from cosmos_cli.report.model import Block, Choice, Figure, Remark
from cosmos_cli.report.sampling import thin
from cosmos_cli.report.source import Source
from cosmos_cli.report.style import groups_of_agents, layout, line
from cosmos_cli.tables import TableReader

POINTS_PER_FIGURE = 40_000
POINTS_PER_TRACE_MAX = 1500
POINTS_PER_TRACE_MIN = 60


def points_per_trace(traces: int) -> int:
    """Return how many points each of so many traces may have, so that the page stays small."""
    share = POINTS_PER_FIGURE // max(traces, 1)
    return max(min(share, POINTS_PER_TRACE_MAX), POINTS_PER_TRACE_MIN)


def grouped_lines(  # noqa: PLR0913 - what is drawn and how it is lettered; five are by name
    table: TableReader,
    source: Source,
    name: str,
    *,
    title: str,
    unit: str,
    note: str = "",
    scale: float = 1.0,
    from_zero: bool = False,
) -> list[Block]:
    """
    Return one field over time for all sources of a table.

    Args:
        table: The stream's table.
        source: The run.
        name: The field.
        title: The figure's.
        unit: Of the ordinate, after scaling.
        note: What a reader should know.
        scale: Factor on the values.
        from_zero: Whether zero is shown in any case.
    """
    points = points_per_trace(len(table.sources))
    choices, x_title = [], ""
    for label, group in groups_of_agents(table.sources):
        traces = []
        for index, agent in enumerate(group):
            x, x_title = source.time_of(table, agent)
            y = source.values(table, agent, name) * scale
            if np.isfinite(y).any():
                x, y = thin(x, y, points)
                traces.append(line(x, y, agent, index, opacity=0.85))
        if traces:
            choices.append(Choice(name=label, traces=traces))
    if not choices:
        return [Remark(text=f"{title}: not a single value was recorded.")]
    figure_layout = layout(x_title, unit, showlegend=True)
    if from_zero:
        figure_layout["yaxis"] |= {"rangemode": "tozero"}
    group_name = "agents" if table.role == "agent" else table.role
    return [
        Figure(
            title=title,
            note=note,
            choices=choices,
            layout=figure_layout,
            group=group_name,
        )
    ]
