"""
Prediction against measurement: what a sensor's model said before, what the hardware did, scored.

The model's errors against truth are the prediction, the device's errors against the same truth the measurement.
The score is the ratio of their root mean squares: 1 for a device that errs as its model does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionScore:
    """How one agent's sensor erred against truth, before by its model and then by its device."""

    measurements: int
    predicted: float
    """Root mean square of the model's errors, in the quantity's unit."""
    measured: float
    """That of the device's."""
    share_within: float
    """Share of the device's errors within SIGMAS of the predicted."""

    @property
    def score(self) -> float | None:
        """Measured over predicted; None of a model without errors."""
        return self.measured / self.predicted if self.predicted > 0.0 else None


def prediction_scores(run: RecordedRun) -> dict[tuple[str, str, str, str], PredictionScore]:
    """Return the scores of all sensors that are hardware, by sensor, quantity, unit and agent."""
    return {
        (name, quantity.title, quantity.unit, agent): score
        for name, table in run.tables.items()
        for quantity in _predicted(table, run)
        for agent, score in _scores(table, run, quantity).items()
    }


def prediction_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the score of a sensor that is hardware, by agent; nothing where no model was recorded beside it."""
    return [
        _table(table.name, quantity, scores)
        for quantity in _predicted(table, run)
        if (scores := _scores(table, run, quantity))
    ]


def _predicted(table: RecordedTable, run: RecordedRun) -> list[Quantity]:
    model, truth = (run.tables.get(table.name + end) for end in (BESIDE_MODEL, BESIDE_TRUTH))
    if model is None or truth is None:
        return []
    return quantities(model.name, model.fields, {truth.name: truth.fields})


def _scores(
    table: RecordedTable, run: RecordedRun, quantity: Quantity
) -> dict[str, PredictionScore]:
    model = run.tables[table.name + BESIDE_MODEL]
    found: dict[str, PredictionScore] = {}
    for agent in model.sources:
        predicted = error_sizes(model, run, agent, quantity)
        measured = error_sizes(table, run, agent, quantity)
        if predicted is None or measured is None:
            continue
        before, after = _finite(predicted[1]), _finite(measured[1])
        if len(before) and len(after):
            rms = _rms(before)
            found[agent] = PredictionScore(
                measurements=len(after),
                predicted=rms,
                measured=_rms(after),
                share_within=float(np.mean(after <= SIGMAS * rms)),
            )
    return found


def _table(name: str, quantity: Quantity, scores: Mapping[str, PredictionScore]) -> TableBlock:
    return TableBlock(
        title=f"{name.replace('_', ' ')}, {quantity.title}: prediction against measurement, {quantity.unit}",
        headings=headings(
            "agent", "measurements", "rms predicted", "rms measured", "score", "share within 3 rms"
        ),
        rows=[
            [agent, one.measurements, one.predicted, one.measured, one.score, one.share_within]
            for agent, one in scores.items()
        ],
        note="Predicted by the model, against truth; score: measured over predicted.",
    )


def _finite(sizes: Floats) -> Floats:
    return sizes[np.isfinite(sizes)]


def _rms(sizes: Floats) -> float:
    return float(np.sqrt(np.mean(sizes * sizes)))
