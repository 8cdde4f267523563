"""Figures of control: maneuvers and what they cost, and what flight software believed of its slot."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.report.figures.generic import generic_blocks
from cosmos_cli.report.figures.grouped import grouped_lines, points_per_trace
from cosmos_cli.report.model import Block, Choice, Figure, Remark, TableBlock, headings
from cosmos_cli.report.sampling import Floats, evenly
from cosmos_cli.report.source import Source
from cosmos_cli.report.style import (
    ACCENT,
    BAD,
    WARM,
    as_array,
    groups_of_agents,
    layout,
    line,
)
from cosmos_cli.spread import Spread
from cosmos_cli.tables import TableReader

MANEUVER_FIELDS = ("commanded_s", "agent", "status", "executed_s", "dv_commanded_m_s")
GIVEN, SLACK, REFUSED, POSTPONED = "dv_given_m_s", "slack_s", "refused", "postponed"
SLOT_ERROR = "slot_error_deg"
SLOT_BINS = 240
Rows = NDArray[np.int64]


def maneuver_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return delta-v over time, the slack of the synchronous inequality, and a table by agent."""
    if not table.has(*MANEUVER_FIELDS, GIVEN, SLACK):
        return generic_blocks(table, source)
    if not table.rows:
        return [Remark(text="No maneuver was commanded.")]
    columns = table.read("host", (*MANEUVER_FIELDS, GIVEN, SLACK))
    agents = columns["agent"].astype(str)
    status = columns["status"].astype(str)
    by_agent = {name: np.flatnonzero(agents == name) for name in sorted(set(agents.tolist()))}
    numbers = {
        name: as_array(values)
        for name, values in columns.items()
        if name not in ("agent", "status")
    }
    return [
        _delta_v(numbers, by_agent, source),
        *_slack(numbers, by_agent),
        _maneuver_table(numbers, by_agent, status),
    ]


def command_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return nothing where the host's account of maneuvers is drawn: it tells the same and more."""
    return [] if "host_maneuvers" in source.tables else generic_blocks(table, source)


def truth_change_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return how each vehicle was told of changes of its truth; nothing where there were none."""
    return generic_blocks(table, source, prefix="Change of truth: ") if table.rows else []


def estimate_blocks(table: TableReader, source: Source) -> list[Block]:
    """Return the slot error of all agents over time and by agent, and every other estimate."""
    others = generic_blocks(table, source, prefix="Estimate: ", without=(SLOT_ERROR,))
    if not table.rows or not table.has(SLOT_ERROR):
        return others
    return [
        _slot_errors(table, source),
        *grouped_lines(
            table,
            source,
            SLOT_ERROR,
            title="Slot error believed, by agent",
            unit="deg",
            note="As flight software believed it.",
        ),
        *others,
    ]


def _delta_v(numbers: Mapping[str, Floats], by_agent: Mapping[str, Rows], source: Source) -> Figure:
    end_s = source.document.get("duration_s")
    points = points_per_trace(len(by_agent))
    choices = []
    for label, group in groups_of_agents(tuple(by_agent)):
        traces = []
        for index, agent in enumerate(group):
            rows = by_agent[agent]
            rows = rows[np.isfinite(numbers["executed_s"][rows])]
            rows = rows[np.argsort(numbers["executed_s"][rows], kind="stable")]
            t_s = numbers["executed_s"][rows]
            spent = np.cumsum(np.nan_to_num(numbers[GIVEN][rows]))
            chosen = evenly(len(t_s), points)
            t_s, spent = t_s[chosen], spent[chosen]
            last = spent[-1:] if len(spent) else np.zeros(1)
            until = [float(end_s)] if isinstance(end_s, int | float) else t_s[-1:].tolist()
            x = np.concatenate(([0.0], t_s, until))
            y = np.concatenate(([0.0], spent, last[: len(until)]))
            trace = line(x, y, agent, index)
            trace["line"] = {**trace["line"], "shape": "hv"}
            traces.append(trace)
        choices.append(Choice(name=label, traces=traces))
    return Figure(
        title="Delta-v spent",
        note="What the thrusters really gave, summed up over each vehicle's maneuvers.",
        choices=choices,
        layout=layout("simulated time, s", "m/s", showlegend=True),
        group="agents",
    )


def _slack(numbers: Mapping[str, Floats], by_agent: Mapping[str, Rows]) -> list[Block]:
    slack_s, commanded_s = numbers[SLACK], numbers["commanded_s"]
    if not np.isfinite(slack_s).any():
        return [Remark(text="Slack of the synchronous inequality: not a single one was measured.")]
    points = points_per_trace(len(by_agent))
    choices = []
    for label, group in groups_of_agents(tuple(by_agent)):
        traces = []
        for index, agent in enumerate(group):
            rows = by_agent[agent]
            rows = rows[np.isfinite(slack_s[rows])]
            rows = rows[_worst_kept(slack_s[rows], points)]
            is_broken = slack_s[rows] < 0.0
            trace = line(commanded_s[rows], slack_s[rows], agent, index, mode="markers")
            colour = trace["line"]["color"]
            trace["marker"] = {
                "size": 5,
                "color": [BAD if broken else colour for broken in is_broken.tolist()],
            }
            traces.append(trace)
        choices.append(Choice(name=label, traces=traces))
    figure_layout = layout("commanded at simulated time, s", "s", showlegend=True)
    figure_layout["yaxis"] |= {"rangemode": "tozero"}
    return [
        Figure(
            title="Slack of the synchronous inequality",
            note="(T_m − T_s) − (T_p + 2 T_n), measured: below zero it is broken.",
            choices=choices,
            layout=figure_layout,
            group="agents",
        )
    ]


def _worst_kept(values: Floats, points: int) -> NDArray[np.int64]:
    """Return which of many to draw: evenly spread, and the smallest in any case."""
    if not len(values):
        return np.empty(0, dtype=np.int64)
    return np.union1d(evenly(len(values), points), [int(values.argmin())])


def _maneuver_table(
    numbers: Mapping[str, Floats], by_agent: Mapping[str, Rows], status: NDArray[np.str_]
) -> TableBlock:
    rows: list[list[object]] = []
    for agent, index in by_agent.items():
        slack_s = numbers[SLACK][index]
        slack_s = slack_s[np.isfinite(slack_s)]
        rows.append(
            [
                agent,
                len(index),
                int((status[index] == POSTPONED).sum()),
                int((status[index] == REFUSED).sum()),
                float(np.nansum(numbers["dv_commanded_m_s"][index])),
                float(np.nansum(numbers[GIVEN][index])),
                float(slack_s.min()) if len(slack_s) else None,
                int((slack_s < 0.0).sum()),
            ]
        )
    return TableBlock(
        title="Maneuvers by agent",
        headings=headings(
            "agent",
            "commanded",
            "postponed",
            "refused",
            "delta-v commanded, m/s",
            "given, m/s",
            "least slack, s",
            "inequality broken",
        ),
        rows=rows,
    )


def _slot_errors(table: TableReader, source: Source) -> Block:
    """Return root mean square and largest slot error of all agents, of every estimate."""
    times, values = {}, {}
    for agent in table.sources:
        t_s, _ = source.time_of(table, agent)
        error_deg = source.values(table, agent, SLOT_ERROR)
        is_there = np.isfinite(t_s) & np.isfinite(error_deg)
        if is_there.any():
            times[agent], values[agent] = t_s[is_there], error_deg[is_there]
    if not times:
        return Remark(text="Slot error: not a single value was recorded.")
    spread = Spread(max(float(t_s.max()) for t_s in times.values()), bins=SLOT_BINS)
    for agent, t_s in times.items():
        spread.add(t_s, values[agent])
    rows = np.array(spread.rows())
    traces = [
        line(rows[:, 0], rows[:, 2], "largest", line={"width": 1.5, "color": WARM}),
        line(rows[:, 0], rows[:, 1], "rms", line={"width": 1.8, "color": ACCENT}),
    ]
    return Figure(
        title="Slot error believed, of all agents",
        note="Root mean square and largest, over every estimate of every agent: not what truth says.",
        choices=[Choice(name="", traces=traces)],
        layout=layout("simulated time, s", "deg", showlegend=True),
    )
