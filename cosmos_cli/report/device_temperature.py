"""Temperatures that devices measure beside that of the board they hang on (thesis, section 7.2.1)."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

import numpy as np

from cosmos_cli.report.health import TEMPERATURE
from madns_runtime.analysis.distribution import summarise
from madns_runtime.analysis.lines import grouped_lines
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import Axis, Block, Floats, TableBlock, headings

DEGREES = "degC"
Curve = tuple[Floats, Floats]
"""Simulated times, s, and temperatures, degC."""


def temperature_blocks(run: RecordedRun) -> list[Block]:
    """Return a figure and a table of all devices that measure a temperature on a board that does; none without."""
    series: dict[str, Curve] = {}
    rows: list[list[object]] = []
    for name, machine, curve in _measured(run):
        board = _board(run, machine)
        of_device, of_board = summarise(curve[1]), summarise(board[1])
        if of_device is None or of_board is None:
            continue
        series[f"{machine}: board"], series[name] = board, curve
        difference = of_device.mean - of_board.mean
        rows.append(
            [name, machine, *(round(v, 3) for v in (of_device.mean, of_board.mean, difference))]
        )
    if not rows:
        return []
    figure = grouped_lines(
        series,
        title="Temperature of devices beside that of their boards",
        y=Axis(unit="\u00b0C"),
        note="A device that a board's processor warms measures that, and not the air around it.",
        group="devices",
    )
    means = TableBlock(
        title="Mean temperatures, \u00b0C",
        headings=headings("device", "machine", "device", "board", "device - board"),
        rows=rows,
    )
    return [*figure, means]


def _measured(run: RecordedRun) -> Iterator[tuple[str, str, Curve]]:
    """Yield each temperature of a device: its name, the machine, and the curve."""
    for table_name, table in run.tables.items():
        fields = [field.name for field in table.fields if field.unit == DEGREES]
        if not table_name.startswith("device_") or not table.has("t_s"):
            continue
        for source in table.sources:
            times_s = run.values(table, source, "t_s")
            for field in fields:
                curve = times_s, run.values(table, source, field)
                yield f"{source} {field}", source.rpartition("/")[0], curve


def _board(run: RecordedRun, machine: str) -> Curve:
    """Return the temperature of a machine's processor over simulated time; empty if it is not known."""
    empty = np.array([]), np.array([])
    table, t0 = run.tables.get("machine_health"), _instant_s(run.document.get("t0_utc"))
    if table is None or machine not in table.sources or not table.has("utc", TEMPERATURE):
        return empty
    if t0 is None:
        return empty
    return _since(table, machine, t0), run.values(table, machine, TEMPERATURE)


def _since(table: RecordedTable, machine: str, t0_s: float) -> Floats:
    texts = table.read(machine, ("utc",))["utc"]
    instants = [_instant_s(text) for text in texts.tolist()]
    return np.array([np.nan if instant is None else instant - t0_s for instant in instants])


def _instant_s(utc: object) -> float | None:
    try:
        return datetime.fromisoformat(str(utc)).timestamp()
    except ValueError:
        return None
