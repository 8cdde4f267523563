"""The comparison of two runs of a constellation as figures over time: truth, slots, estimates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from madns_runtime.analysis.values import Axis, Figure, FigureChoice, Series
from madns_runtime.simulations.constellation.analysis.comparison import ConstellationDifference

STRETCHES = "One point per stretch of time, at its end."
SLOT_ERROR = Axis(quantity="slot error rms", unit="deg", from_zero=True)


def comparison_figures(found: ConstellationDifference) -> Iterator[Figure]:
    """Yield figures of what both runs have: distance of truth, slot errors by truth and as estimated."""
    if len(found.over_time) > 1:
        t_s, rms_m, max_m = np.array(found.over_time).T
        marks = [Series(x=t_s, y=rms_m, name="rms"), Series(x=t_s, y=max_m, name="largest")]
        yield Figure(
            title="Truth: distance between A and B",
            note=STRETCHES,
            y=Axis(quantity="distance", unit="m", from_zero=True),
            choices=[FigureChoice(marks=marks)],
        )
    by_truth = [[(row.t_s, row.slot_error_deg_rms) for row in rows] for rows in found.slots]
    yield from _slot_errors("Slot error by truth", by_truth)
    estimated = [[(t_s, rms) for t_s, rms, _ in rows] for rows in found.slot_over_time]
    yield from _slot_errors("Slot error as flight software believed it", estimated, STRETCHES)


def _slot_errors(
    title: str, runs: Sequence[Sequence[tuple[float, float | None]]], note: str = ""
) -> Iterator[Figure]:
    """Yield the figure of slot errors over time, of the runs that have any."""
    marks = []
    for name, points in zip(("A", "B"), runs, strict=True):
        if len(points) > 1:
            t_s, error_deg = np.array(points, dtype=np.float64).T
            marks.append(Series(x=t_s, y=error_deg, name=name))
    if marks:
        yield Figure(title=title, note=note, y=SLOT_ERROR, choices=[FigureChoice(marks=marks)])
