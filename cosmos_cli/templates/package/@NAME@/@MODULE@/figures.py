"""Figures that a report shows of a run beyond one line per number: values, which `cosmos report` draws."""

from __future__ import annotations

from madns_runtime.analysis.chapters import Chapter, build_sections
from madns_runtime.analysis.sampling import evenly
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import Axis, Block, Figure, FigureChoice, Section, Series

from @MODULE@.streams import TRUTH

POINTS_MAX = 500


def figures(run: RecordedRun) -> list[Section]:
    """Return the chapters of a run: which table gets which figures."""
    return build_sections({"host_truth": Chapter("Rovers", position_blocks, TRUTH)}, run)


def position_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return where all rovers were, over time."""
    marks = []
    for rover, (t_s, position_m) in run.series(table, "position_m")[0].items():
        shown = evenly(len(t_s), POINTS_MAX)
        marks.append(Series(x=t_s[shown], y=position_m[shown], name=rover))
    return [
        Figure(
            title="Positions of all rovers",
            y=Axis(quantity="position", unit="m"),
            choices=[FigureChoice(marks=marks)],
        )
    ]
