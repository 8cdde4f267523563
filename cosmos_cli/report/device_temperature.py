"""Temperatures that devices measure beside that of the board they hang on (thesis, section 7.2.1)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from cosmos_cli.evidence.run_log import posix_s, zero_in
from cosmos_cli.evidence.streams import is_linked
from cosmos_cli.report.health import TEMPERATURE
from madns_runtime.analysis.distribution import summarise
from madns_runtime.analysis.lines import grouped_lines
from madns_runtime.analysis.tables import RecordedRun
from madns_runtime.analysis.values import Axis, Block, Floats, TableBlock, headings
from madns_runtime.bounded_files import open_regular_file

DEGREES = "degC"
HEAD_BYTES: Final = 65_536
"""Of a stream: its schema, and the line behind it that tells when simulated time began."""
Curve = tuple[Floats, Floats]
"""Simulated times, s, and temperatures, degC."""


def temperature_blocks(run: RecordedRun, folder: Path) -> list[Block]:
    """
    Return a figure and a table of all devices that measure a temperature on a board that does; none without.

    Args:
        run: The run.
        folder: Its directory: devices' records tell there when simulated time began by their board's clock.
    """
    series: dict[str, Curve] = {}
    rows: list[list[object]] = []
    hosts_zero_s = posix_s(run.document.get("t0_utc"))
    for name, device, stream, curve in _measured(run):
        machine = device.rpartition("/")[0]
        zero_s = _zero_s(folder, device, stream)
        board = _board(run, machine, hosts_zero_s if zero_s is None else zero_s)
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


def _measured(run: RecordedRun) -> Iterator[tuple[str, str, str, Curve]]:
    """Yield each temperature of a device: its name, the device's full one, the stream, and the curve."""
    for table_name, table in run.tables.items():
        fields = [field.name for field in table.fields if field.unit == DEGREES]
        if not table_name.startswith("device_") or not table.has("t_s"):
            continue
        stream = table_name.rpartition(".")[2]
        for source in table.sources:
            times_s = run.values(table, source, "t_s")
            for field in fields:
                curve = times_s, run.values(table, source, field)
                yield f"{source} {field}", source, stream, curve


def _board(run: RecordedRun, machine: str, zero_s: float) -> Curve:
    """Return the temperature of a machine's processor over simulated time; empty if it is not known."""
    table = run.tables.get("machine_health")
    if table is None or machine not in table.sources or not table.has("utc", TEMPERATURE):
        return np.array([]), np.array([])
    instants = [posix_s(text) for text in table.read(machine, ("utc",))["utc"].tolist()]
    since_s = np.array(instants, dtype=np.float64) - zero_s
    return np.where(np.isfinite(since_s), since_s, np.nan), run.values(table, machine, TEMPERATURE)


def _zero_s(folder: Path, device: str, stream: str) -> float | None:
    """Return simulated time zero by the clock of a device's machine, as its records tell it, as a POSIX time, s."""
    path = folder / "devices" / device / f"{stream}.jsonl"
    if is_linked(path, folder):
        return None
    try:
        with os.fdopen(open_regular_file(path), "rb") as file:
            return zero_in(file.read(HEAD_BYTES).decode(errors="replace"))
    except OSError:
        return None
