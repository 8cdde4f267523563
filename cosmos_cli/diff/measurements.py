"""How far what sensors said was from truth, in each run by itself."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cosmos_cli.diff.matching import Rows, joined, match
from cosmos_cli.diff.recorded import ROWS_READ_MAX, Key, Recorded
from cosmos_cli.measured import SAME_INSTANT_S, TRUTH_TABLES, Quantity, quantities
from cosmos_cli.report.style import as_array


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
        """What the same of the other run is found by."""
        return self.sensor, self.quantity


def measurement_errors(
    streams: Mapping[Key, Recorded], tick_hz: float
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
        truths = {name: streams[name, agent] for name in TRUTH_TABLES if (name, agent) in streams}
        fields = {name: truth.fields for name, truth in truths.items()}
        for quantity in quantities(table, recorded.fields, fields):
            error = MeasurementError(sensor=table, quantity=quantity.title, unit=quantity.unit)
            error = found.setdefault(error.key, error)
            _add(error, recorded, truths[quantity.truth], quantity, tick_hz)
    return found


def _add(
    error: MeasurementError,
    measured: Recorded,
    truth: Recorded,
    quantity: Quantity,
    tick_hz: float,
) -> None:
    sides = (
        _rows(measured, quantity, "t_s", 1.0),
        _rows(truth, quantity, "tick", 1.0 / tick_hz),
    )
    for piece in match(*sides, tolerance=SAME_INSTANT_S):
        if len(piece.a):
            sizes = quantity.sizes(piece.a.columns, piece.b.columns)
            sizes = sizes[np.isfinite(sizes)]
            error.count += len(sizes)
            error.squares += float(np.dot(sizes, sizes))
            error.max = max(error.max, float(sizes.max(initial=0.0)))


def _rows(recorded: Recorded, quantity: Quantity, key: str, scale: float) -> Iterator[Rows]:
    def rows_of(columns: Mapping[str, np.ndarray]) -> Rows:
        keys = as_array(columns[key]) * scale
        who = np.zeros(len(keys), dtype=np.int8)
        return Rows(keys=keys, who=who, columns=dict(columns))

    yield rows_of({name: np.empty(0) for name in (key, *quantity.names)})
    batches = (rows_of(columns) for columns in recorded.batches((key, *quantity.names)))
    yield from joined(batches, ROWS_READ_MAX)
