"""
Measurement minus truth, where a run recorded both: which fields belong together, and the size of the error.

Every run is judged by itself. A sensor's field is held against the field of the same name among truth ("state",
"attitude") at the same time; that of a sensor that is hardware against what was recorded beside it in the same tick:
truth as an instrument without errors would have measured it ("gyro_truth"), and the model ("gyro_model"). Pure numpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from madns_runtime.analysis.lines import generic_blocks, grouped_lines
from madns_runtime.analysis.matching import Rows, joined, match
from madns_runtime.analysis.sampling import as_array, as_rows
from madns_runtime.analysis.tables import Columns, ComparedStream, Key, RecordedRun, RecordedTable
from madns_runtime.analysis.values import Axis, Block, Floats, ReportRemark, TableBlock, headings
from madns_runtime.recording.records import Field

TRUTH_TABLES = ("state", "attitude")
NO_MEASUREMENTS = (*TRUTH_TABLES, "elements", "estimates", "commands", "command_results")
KEYS = ("tick", "t_s")
QUATERNION = ("q1", "q2", "q3", "q4")
SAME_INSTANT_S = 1e-6
"""A measurement's time of validity is that of a tick."""
TITLES = {
    "m": "position",
    "m/s": "velocity",
    "rad/s": "body rates",
    "deg": "attitude",
    "m/s^2": "specific force",
    "T": "field",
}
BESIDE_TRUTH, BESIDE_MODEL = "_truth", "_model"
"""Ends of the names of tables that stand beside a sensor that is hardware."""

ROWS_MATCHED_MIN = 16_384
"""Records of one stream that are matched at a time."""

Errors = dict[str, tuple[Floats, Floats]]
"""By agent: time, s, and size of the error."""
VALID_AT = Axis(quantity="valid at simulated time", unit="s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """Fields of one sensor that make one error."""

    truth: str
    """Table of the truth."""
    names: tuple[str, ...]
    unit: str
    by_tick: bool = False
    """Whether partners share a tick: truth was recorded beside the measurement; else they share a time."""
    of: str = ""
    """Addition to the title: what is held against what."""

    @property
    def title(self) -> str:
        """Name of the quantity."""
        return TITLES.get(self.unit, ", ".join(self.names)) + self.of

    def sizes(self, measured: Mapping[str, Any], truth: Mapping[str, Any]) -> Floats:
        """
        Return the size of the error of each measurement.

        Args:
            measured: Columns, shape (N,).
            truth: Columns of the same instants.

        Returns:
            Shape (N,): the difference's norm; of quaternions the angle between them, deg.
        """
        first = as_rows(measured, self.names)
        second = as_rows(truth, self.names)
        if self.names != QUATERNION:
            return np.asarray(np.linalg.norm(first - second, axis=1))
        # A quaternion and its negative are one attitude; small angles need the chord, not the cosine.
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second /= np.linalg.norm(second, axis=1, keepdims=True)
        chord = np.minimum(
            np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1)
        )
        return np.asarray(np.degrees(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))))


def quantities(
    table: str, fields: Sequence[Field], truths: Mapping[str, Sequence[Field]]
) -> list[Quantity]:
    """
    Return what of a sensor's records can be held against truth; nothing for what is no sensor.

    Args:
        table: Name of the sensor's table.
        fields: Its fields.
        truths: Fields of the tables that the run recorded, those of `truth_tables` among them.
    """
    if table in NO_MEASUREMENTS or "t_s" not in {field.name for field in fields}:
        return []
    found: list[Quantity] = []
    for truth in truth_tables(table):
        there = {field.name for field in truths.get(truth, ())} - set(KEYS)
        units: dict[str, list[str]] = {}
        for field in fields:
            if field.name in there:
                unit = "deg" if field.name in QUATERNION else field.unit
                units.setdefault(unit, []).append(field.name)
        beside = truth not in TRUTH_TABLES
        of = ""
        if beside and not table.endswith(BESIDE_MODEL):
            of = " of the device" + (" against its model" if truth.endswith(BESIDE_MODEL) else "")
        found += [
            Quantity(truth=truth, names=tuple(n), unit=unit, by_tick=beside, of=of)
            for unit, n in units.items()
        ]
    return found


def truth_tables(table: str) -> tuple[str, ...]:
    """Return the names of tables that a sensor's can be held against, where a run has them."""
    if table.endswith(BESIDE_TRUTH):
        return ()
    if table.endswith(BESIDE_MODEL):
        return (table.removesuffix(BESIDE_MODEL) + BESIDE_TRUTH,)
    return (*TRUTH_TABLES, table + BESIDE_TRUTH, table + BESIDE_MODEL)


@dataclass(slots=True, kw_only=True)
class MeasurementError:
    """Errors of one quantity of one sensor, over all agents."""

    sensor: str
    quantity: str
    unit: str
    count: int = 0
    squares: float = 0.0
    max: float = 0.0

    @property
    def rms(self) -> float:
        """Root mean square."""
        return math.sqrt(self.squares / self.count) if self.count else 0.0

    @property
    def key(self) -> tuple[str, str]:
        """Key by which the same of the other run is found."""
        return self.sensor, self.quantity


def measurement_errors(
    streams: Mapping[Key, ComparedStream], tick_hz: float
) -> dict[tuple[str, str], MeasurementError]:
    """
    Return the errors of all sensors whose truth was recorded.

    Raises:
        MachineError: A file cannot be read.
    """
    found: dict[tuple[str, str], MeasurementError] = {}
    for (table, agent), recorded in streams.items():
        if recorded.role != "agent":
            continue
        names = truth_tables(table)
        if (table + BESIDE_TRUTH, agent) in streams:
            names = tuple(name for name in names if name not in TRUTH_TABLES)
        truths = {name: streams[name, agent] for name in names if (name, agent) in streams}
        fields = {name: truth.fields for name, truth in truths.items()}
        for quantity in quantities(table, recorded.fields, fields):
            error = MeasurementError(sensor=table, quantity=quantity.title, unit=quantity.unit)
            error = found.setdefault(error.key, error)
            _add(error, recorded, truths[quantity.truth], quantity, tick_hz)
    return found


def _add(
    error: MeasurementError,
    measured: ComparedStream,
    truth: ComparedStream,
    quantity: Quantity,
    tick_hz: float,
) -> None:
    key = "tick" if quantity.by_tick else "t_s"
    scale = 1.0 / tick_hz if quantity.by_tick else 1.0
    sides = (
        rows_over_time(measured, quantity.names, key, scale),
        rows_over_time(truth, quantity.names, "tick", 1.0 / tick_hz),
    )
    for piece in match(*sides, tolerance=SAME_INSTANT_S):
        if len(piece.a):
            sizes = quantity.sizes(piece.a.columns, piece.b.columns)
            sizes = sizes[np.isfinite(sizes)]
            error.count += len(sizes)
            error.squares += float(np.dot(sizes, sizes))
            error.max = max(error.max, float(sizes.max(initial=0.0)))


def rows_over_time(
    recorded: ComparedStream, names: Sequence[str], key: str, scale: float = 1.0
) -> Iterator[Rows]:
    """Yield a stream's records for `match`, keyed by a field times *scale*, s; the first batch is empty."""

    def rows_of(columns: Columns) -> Rows:
        keys = as_array(columns[key]) * scale
        return Rows(keys=keys, who=np.zeros(len(keys), dtype=np.int8), columns=dict(columns))

    yield rows_of({name: np.empty(0) for name in (key, *names)})
    batches = (rows_of(columns) for columns in recorded.batches((key, *names)))
    yield from joined(batches, ROWS_MATCHED_MIN)


def sensor_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the errors of a sensor over time and a table of them; its values where truth has none."""
    known = truth_tables(table.name)
    truths = {name: run.tables[name].fields for name in known if name in run.tables}
    blocks: list[Block] = []
    for quantity in quantities(table.name, table.fields, truths):
        errors = {
            agent: found
            for agent in table.sources
            if (found := error_sizes(table, run, agent, quantity)) is not None
        }
        name = f"{table.name.replace('_', ' ')}, {quantity.title}"
        if errors:
            blocks += grouped_lines(
                errors,
                title=f"Error of {name}",
                x=VALID_AT,
                y=Axis(unit=quantity.unit, from_zero=True),
                note="Size of measurement minus truth, at the time for which the measurement was valid.",
            )
            blocks.append(_table(errors, quantity, name))
        elif table.rows:
            blocks.append(
                ReportRemark(text=f"{name}: truth was recorded at no measurement's time.")
            )
    return blocks or generic_blocks(table, run)


def error_sizes(
    table: RecordedTable, run: RecordedRun, agent: str, quantity: Quantity
) -> tuple[Floats, Floats] | None:
    """Return the times for which one agent's measurements were valid, s, and their errors; None without truth."""
    truth, beside = run.tables[quantity.truth], run.tables.get(table.name + BESIDE_TRUTH)
    if agent not in truth.sources:
        return None
    if not quantity.by_tick and beside is not None and agent in beside.sources:
        return None  # what was recorded beside it tells more
    measured_s, _ = run.time_of(table, agent)
    if quantity.by_tick:
        keys = as_array(table.read(agent, ("tick",))["tick"])
        of_truth_keys = as_array(truth.read(agent, ("tick",))["tick"])
    else:
        keys, (of_truth_keys, _) = measured_s, run.time_of(truth, agent)
    if not len(keys) or not len(of_truth_keys):
        return None
    order = np.argsort(of_truth_keys, kind="stable")
    place = np.clip(np.searchsorted(of_truth_keys[order], keys), 0, len(order) - 1)
    before = np.maximum(place - 1, 0)
    closer = np.abs(of_truth_keys[order][before] - keys) < np.abs(
        of_truth_keys[order][place] - keys
    )
    partner = order[np.where(closer, before, place)]
    is_there = np.abs(of_truth_keys[partner] - keys) <= SAME_INSTANT_S
    if not is_there.any():
        return None
    columns = table.read(agent, quantity.names)
    of_truth = truth.read(agent, quantity.names)
    sizes = quantity.sizes(
        {name: values[is_there] for name, values in columns.items()},
        {name: values[partner[is_there]] for name, values in of_truth.items()},
    )
    return measured_s[is_there], sizes


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
