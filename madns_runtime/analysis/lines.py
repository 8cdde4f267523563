"""Time series of many agents, in groups of five that a reader chooses between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.breaks import NOWHERE
from madns_runtime.analysis.sampling import SERIES_PER_FIGURE, drawn_series, points_per_series
from madns_runtime.analysis.tables import AGENT, RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    SIMULATED_TIME,
    Axis,
    Block,
    Figure,
    FigureChoice,
    Floats,
    LimitLine,
    ReportRemark,
    Series,
)
from madns_runtime.recording.records import Field

GROUP_SIZE = 5
"""As in the thesis: no more lines stay apart on paper."""
GROUP_RANGE = " … "
"""Between the first and the last name of a group."""
FIGURES_MAX = 12
TIME_FIELDS = ("t_s", "tick", "packet", "monotonic_s")


def groups_of_agents(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return the names in groups of five, each with the label of its choice."""
    groups = [list(names[start : start + GROUP_SIZE]) for start in range(0, len(names), GROUP_SIZE)]
    return [(g[0] if len(g) == 1 else GROUP_RANGE.join((g[0], g[-1])), g) for g in groups]


def grouped_lines(  # noqa: PLR0913 - what is drawn and how it is lettered; all but one by name
    series: Mapping[str, tuple[Floats, Floats]],
    *,
    title: str,
    y: Axis,
    x: Axis = SIMULATED_TIME,
    note: str = "",
    form: Literal["line", "steps", "points", "joined points"] = "line",
    group: str = "agents",
    limits: Sequence[LimitLine] = (),
    returns: Mapping[str, NDArray[np.int64]] | None = None,
) -> list[Block]:
    """
    Return one figure of a quantity of many, thinned; a remark if there is not a single value, or on those left out.

    No line goes through a gap in samples that else come regularly, nor over an angle's wrap.

    Args:
        series: Abscissae and ordinates by whose they are; the first SERIES_PER_FIGURE are drawn.
        title: The figure's.
        y: The ordinate.
        x: The abscissa.
        note: What a reader should know.
        form: How values are joined.
        group: Figures of one group change their choice together.
        limits: What should not be passed.
        returns: Numbers of the samples before which the line is broken, by whose they are.
    """
    drawn = tuple(series)[:SERIES_PER_FIGURE]
    points = points_per_series(len(drawn))
    choices = []
    starts = returns or {}
    for label, names in groups_of_agents(drawn):
        marks = [
            drawn_series(
                Series(x=series[name][0], y=series[name][1], name=name, form=form),
                points,
                unit=y.unit,
                returns=starts.get(name, NOWHERE),
            )
            for name in names
            if np.isfinite(series[name][1]).any()
        ]
        if marks:
            choices.append(FigureChoice(name=label, marks=marks))
    left_out = []
    if (more := len(series) - len(drawn)) > 0:
        text = f"{title}: {more} of {len(series)} are not drawn, those behind {drawn[-1]}."
        left_out = [ReportRemark(text=text)]
    if not choices:
        return [ReportRemark(text=f"{title}: not a single value was recorded."), *left_out]
    figure = Figure(title=title, note=note, x=x, y=y, choices=choices, group=group, limits=limits)
    return [figure, *left_out]


def field_lines(  # noqa: PLR0913 - a field, and how it is lettered
    table: RecordedTable,
    run: RecordedRun,
    name: str,
    *,
    title: str,
    y: Axis,
    note: str = "",
    scale: float = 1.0,
) -> list[Block]:
    """
    Return one field over time for all sources of a table.

    Args:
        table: The stream's table.
        run: The run.
        name: The field.
        title: The figure's.
        y: The ordinate, after scaling.
        note: What a reader should know.
        scale: Factor on the values.
    """
    series, x = run.series(table, name)
    is_of_agents = table.role == AGENT or len(series) > len(table.sources)
    return grouped_lines(
        {who: (times, values * scale) for who, (times, values) in series.items()},
        title=title,
        x=x,
        y=y,
        note=note,
        group="agents" if is_of_agents else table.role,
        returns=run.series_returns(table, series),
    )


def generic_blocks(
    table: RecordedTable, run: RecordedRun, *, prefix: str = "", without: Sequence[str] = ()
) -> list[Block]:
    """Return one figure per numeric field, in the stream's order; titles begin with *prefix*."""
    if not table.rows:
        return [ReportRemark(text=f"The stream {table.name} holds no record.")]
    numeric = [
        field
        for field in table.fields
        if field.kind in ("float", "int") and field.name not in (*TIME_FIELDS, *without)
    ]
    blocks: list[Block] = []
    for field in numeric[:FIGURES_MAX]:
        title = f"{prefix}{title_of(field)}"
        blocks += field_lines(table, run, field.name, title=title, y=Axis(unit=field.unit))
    if len(numeric) > FIGURES_MAX:
        rest = ", ".join(field.name for field in numeric[FIGURES_MAX:])
        blocks.append(ReportRemark(text=f"Not drawn, but in tables/{table.name}.parquet: {rest}."))
    if not numeric and not without:
        blocks.append(ReportRemark(text=f"The stream {table.name} has no numbers to draw."))
    return blocks


def title_of(field: Field) -> str:
    """Return a field's name in words, without the unit that ends it: that stands at the axis."""
    unit = field.unit.lower().replace("^", "").translate(str.maketrans("/ ", "__"))
    return field.name.removesuffix(f"_{unit}").replace("_", " ")
