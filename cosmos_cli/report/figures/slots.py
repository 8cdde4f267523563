"""The figures and the table of a constellation under control: slot error by truth, delta-v, messages."""

from __future__ import annotations

import numpy as np

from cosmos_cli.report.control import ControlRow
from cosmos_cli.report.model import Block, Choice, Figure, TableBlock, headings
from cosmos_cli.report.sampling import Floats, evenly
from cosmos_cli.report.style import layout, line

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


def slot_blocks(rows: tuple[ControlRow, ...]) -> list[Block]:
    """Return slot error, delta-v and messages over time; nothing without slots."""
    if not rows:
        return []
    hours = np.array([row.t_s / 3600.0 for row in rows])
    errors = [
        line(hours, _values([row.slot_error_deg_rms for row in rows]), "rms", 0),
        line(hours, _values([row.slot_error_deg_max for row in rows]), "largest", 1),
        line(
            hours,
            _values([row.slot_error_estimated_deg_rms for row in rows]),
            "rms as believed",
            2,
        ),
    ]
    shown = [rows[index] for index in evenly(len(rows), ROWS_SHOWN).tolist()]
    return [
        Figure(
            title="Slot error, by truth",
            choices=[Choice(name="all", traces=errors)],
            layout=layout("simulated time, h", "deg", showlegend=True),
        ),
        *_delta_v(rows, hours),
        TableBlock(
            title="Slots over time",
            headings=headings("time", *COLUMNS),
            rows=[_cells(row) for row in shown],
            note="Slot errors are those of the recorded truth, about the ring's common phase.",
        ),
    ]


def _delta_v(rows: tuple[ControlRow, ...], hours: Floats) -> list[Figure]:
    """Return the delta-v over time; nothing where none was given, as under control by drag."""
    if not rows[-1].delta_v_m_s_max:
        return []
    spent = [
        line(hours, np.array([row.delta_v_m_s_mean for row in rows]), "mean", 0),
        line(hours, np.array([row.delta_v_m_s_max for row in rows]), "largest", 1),
    ]
    return [
        Figure(
            title="Delta-v given",
            choices=[Choice(name="all", traces=spent)],
            layout=layout("simulated time, h", "m/s", showlegend=True),
        )
    ]


def _values(values: list[float | None]) -> Floats:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


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
