"""
Prediction against measurement: what a sensor's model said before, what the hardware did, scored.

The model's errors against truth are the prediction, the device's errors against the same truth the measurement.
The score is the ratio of their root mean squares: 1 for a device that errs as its model does.
"""

from __future__ import annotations

import numpy as np

from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import Block, Floats, TableBlock, headings
from madns_runtime.simulations.constellation.analysis.measurement_errors import (
    BESIDE_MODEL,
    BESIDE_TRUTH,
    Quantity,
    error_sizes,
    quantities,
)

SIGMAS = 3.0
"""Within so many times the model's root mean square a measurement is as predicted."""


def prediction_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the score of a sensor that is hardware, by agent; nothing where no model was recorded beside it."""
    model, truth = (run.tables.get(table.name + end) for end in (BESIDE_MODEL, BESIDE_TRUTH))
    if model is None or truth is None:
        return []
    found = (
        _scores(table, model, run, quantity)
        for quantity in quantities(model.name, model.fields, {truth.name: truth.fields})
    )
    return [block for block in found if block.rows]


def _scores(
    table: RecordedTable, model: RecordedTable, run: RecordedRun, quantity: Quantity
) -> TableBlock:
    rows: list[list[object]] = []
    for agent in model.sources:
        predicted = error_sizes(model, run, agent, quantity)
        measured = error_sizes(table, run, agent, quantity)
        if predicted is None or measured is None:
            continue
        before, after = _finite(predicted[1]), _finite(measured[1])
        if not len(before) or not len(after):
            continue
        rms_before, rms_after = _rms(before), _rms(after)
        score = rms_after / rms_before if rms_before > 0.0 else None
        within = float(np.mean(after <= SIGMAS * rms_before))
        rows.append([agent, len(after), rms_before, rms_after, score, within])
    return TableBlock(
        title=f"{table.name.replace('_', ' ')}, {quantity.title}: prediction against measurement, {quantity.unit}",
        headings=headings(
            "agent", "measurements", "rms predicted", "rms measured", "score", "share within 3 rms"
        ),
        rows=rows,
        note="Predicted by the model, against truth; score: measured over predicted.",
    )


def _finite(sizes: Floats) -> Floats:
    return sizes[np.isfinite(sizes)]


def _rms(sizes: Floats) -> float:
    return float(np.sqrt(np.mean(sizes * sizes)))
