"""Figures of control: maneuvers and what they cost, slots by truth, and what flight software believed of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.lines import field_lines, generic_blocks, grouped_lines
from madns_runtime.analysis.sampling import BinnedRms, as_array, evenly
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Block,
    Figure,
    FigureChoice,
    Floats,
    LimitLine,
    ReportRemark,
    Series,
    TableBlock,
    headings,
)
from madns_runtime.simulations.constellation.analysis.burn_ends import TIMES, ends_s
from madns_runtime.simulations.constellation.analysis.slots import ControlRow

MANEUVER_FIELDS = ("commanded_s", "agent", "status", "executed_s", "dv_commanded_m_s")
GIVEN, SLACK, REFUSED, POSTPONED = "dv_given_m_s", "slack_s", "refused", "postponed"
SLOT_ERROR = "slot_error_deg"
SLOT_BINS = 240
Rows = NDArray[np.int64]

HOURS = Axis(quantity="simulated time", unit="h")
ROWS_SHOWN = 13
"""Of a day: every two hours."""
COLUMNS = (
    "satellites",
    "slot error rms, deg",
    "max, deg",
    "believed rms, deg",
    "delta-v mean, m/s",
    "max, m/s",
    "messages",
    "mean height, km",
)


def maneuver_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return delta-v over time, the slack of the synchronous inequality, and a table by agent."""
    if not table.has(*MANEUVER_FIELDS, GIVEN, SLACK):
        return generic_blocks(table, run)
    if not table.rows:
        return [ReportRemark(text="No maneuver was commanded.")]
    times = (name for name in TIMES if table.has(name))
    columns = table.read("host", tuple(dict.fromkeys((*MANEUVER_FIELDS, GIVEN, SLACK, *times))))
    agents = columns["agent"].astype(str)
    status = columns["status"].astype(str)
    by_agent = {name: np.flatnonzero(agents == name) for name in sorted(set(agents.tolist()))}
    numbers = {
        name: as_array(values)
        for name, values in columns.items()
        if name not in ("agent", "status")
    }
    # What was to be given after the run had ended was not, and a burn under way then is not over.
    end_s = run.end_s
    is_after = ends_s(numbers) > end_s
    numbers[GIVEN] = np.where(is_after, 0.0, numbers[GIVEN])
    numbers["executed_s"] = np.where(is_after, np.nan, numbers["executed_s"])
    return [
        *_delta_v(numbers, by_agent, end_s),
        *_slack(numbers, by_agent),
        _maneuver_table(numbers, by_agent, status),
    ]


def command_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return nothing where the host's account of maneuvers is drawn: it tells the same and more."""
    return [] if "host_maneuvers" in run.tables else generic_blocks(table, run)


def truth_change_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return how each vehicle was told of changes of its truth; nothing where there were none."""
    return generic_blocks(table, run, prefix="Change of truth: ") if table.rows else []


def estimate_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the slot error of all agents over time and by agent, and every other estimate."""
    others = generic_blocks(table, run, prefix="Estimate: ", without=(SLOT_ERROR,))
    if not table.rows or not table.has(SLOT_ERROR):
        return others
    return [
        _slot_errors(table, run),
        *field_lines(
            table,
            run,
            SLOT_ERROR,
            title="Slot error believed, by agent",
            y=Axis(unit="deg"),
            note="As flight software believed it.",
        ),
        *others,
    ]


def _delta_v(
    numbers: Mapping[str, Floats], by_agent: Mapping[str, Rows], end_s: float
) -> list[Block]:
    spent_by = {}
    for agent, rows in by_agent.items():
        rows = rows[np.isfinite(numbers["executed_s"][rows])]  # noqa: PLW2901 - of them those executed
        rows = rows[np.argsort(numbers["executed_s"][rows], kind="stable")]  # noqa: PLW2901 - in order
        t_s = numbers["executed_s"][rows]
        spent = np.concatenate(([0.0], np.cumsum(np.nan_to_num(numbers[GIVEN][rows]))))
        until_s = [end_s] if math.isfinite(end_s) else t_s[-1:].tolist()
        x = np.concatenate(([0.0], t_s, until_s))
        spent_by[agent] = (x, np.concatenate((spent, spent[-1:]))[: len(x)])
    return grouped_lines(
        spent_by,
        title="Delta-v spent",
        note="What the thrusters really gave, summed up over each vehicle's maneuvers that were over by the end.",
        y=Axis(unit="m/s"),
        form="steps",
    )


def _slack(numbers: Mapping[str, Floats], by_agent: Mapping[str, Rows]) -> list[Block]:
    slack_s = numbers[SLACK]
    if not np.isfinite(slack_s).any():
        return [
            ReportRemark(text="Slack of the synchronous inequality: not a single one was measured.")
        ]
    measured = {a: rows[np.isfinite(slack_s[rows])] for a, rows in by_agent.items()}
    return grouped_lines(
        {agent: (numbers["commanded_s"][rows], slack_s[rows]) for agent, rows in measured.items()},
        title="Slack of the synchronous inequality",
        note="(T_m − T_s) − (T_p + 2 T_n), measured: below zero it is broken.",
        x=Axis(quantity="commanded at simulated time", unit="s"),
        y=Axis(unit="s", from_zero=True),
        form="points",
        limits=[LimitLine(value=0.0, is_least=True)],
    )


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


def _slot_errors(table: RecordedTable, run: RecordedRun) -> Block:
    """Return root mean square and largest slot error of all agents, of every estimate."""
    times, values = {}, {}
    for agent in table.sources:
        t_s, _ = run.time_of(table, agent)
        error_deg = run.values(table, agent, SLOT_ERROR)
        is_there = np.isfinite(t_s) & np.isfinite(error_deg)
        if is_there.any():
            times[agent], values[agent] = t_s[is_there], error_deg[is_there]
    if not times:
        return ReportRemark(text="Slot error: not a single value was recorded.")
    spread = BinnedRms(max(float(t_s.max()) for t_s in times.values()), bins=SLOT_BINS)
    for agent, t_s in times.items():
        spread.add(t_s, values[agent])
    rows = np.array(spread.rows())
    marks = [
        Series(x=rows[:, 0], y=rows[:, 2], name="largest", tone="warm"),
        Series(x=rows[:, 0], y=rows[:, 1], name="rms", tone="main"),
    ]
    return Figure(
        title="Slot error believed, of all agents",
        note="Root mean square and largest, over every estimate of every agent: not what truth says.",
        y=Axis(unit="deg"),
        choices=[FigureChoice(marks=marks)],
    )


def slot_blocks(rows: tuple[ControlRow, ...]) -> list[Block]:
    """Return slot error, delta-v and messages over time; nothing without slots."""
    if not rows:
        return []
    hours = np.array([row.t_s / 3600.0 for row in rows])
    errors = {
        "rms": [row.slot_error_deg_rms for row in rows],
        "largest": [row.slot_error_deg_max for row in rows],
        "rms as believed": [row.slot_error_estimated_deg_rms for row in rows],
    }
    shown = [rows[index] for index in evenly(len(rows), ROWS_SHOWN).tolist()]
    return [
        _figure("Slot error, by truth", "deg", hours, errors),
        *_slots_delta_v(rows, hours),
        TableBlock(
            title="Slots over time",
            headings=headings("time", *COLUMNS),
            rows=[_cells(row) for row in shown],
            note="Slot errors are those of the recorded truth, about the ring's common phase.",
        ),
    ]


def _slots_delta_v(rows: tuple[ControlRow, ...], hours: Floats) -> list[Figure]:
    """Return the delta-v over time; nothing where none was given, as under control by drag."""
    if not rows[-1].delta_v_m_s_max:
        return []
    spent: dict[str, list[float | None]] = {
        "mean": [row.delta_v_m_s_mean for row in rows],
        "largest": [row.delta_v_m_s_max for row in rows],
    }
    return [_figure("Delta-v given", "m/s", hours, spent)]


def _figure(title: str, unit: str, hours: Floats, curves: dict[str, list[float | None]]) -> Figure:
    marks = [
        Series(x=hours, y=np.array(values, dtype=np.float64), name=name)
        for name, values in curves.items()
    ]
    return Figure(
        title=title,
        x=HOURS,
        y=Axis(unit=unit),
        choices=[FigureChoice(name="all", marks=marks)],
    )


def _cells(row: ControlRow) -> list[object]:
    return [
        f"{row.t_s / 3600.0:.4g} h",
        row.satellites,
        row.slot_error_deg_rms,
        row.slot_error_deg_max,
        row.slot_error_estimated_deg_rms,
        row.delta_v_m_s_mean,
        row.delta_v_m_s_max,
        row.messages,
        row.height_km,
    ]
