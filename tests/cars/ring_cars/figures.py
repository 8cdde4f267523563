"""What a report shows of the cars, and what a comparison tells: values, which the operator's side draws."""

from __future__ import annotations

import numpy as np

from madns_runtime.analysis.chapters import Chapter, build_sections
from madns_runtime.analysis.sampling import evenly
from madns_runtime.analysis.tables import ComparedRun, RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Block,
    Figure,
    FigureChoice,
    Floats,
    LimitLine,
    Section,
    Series,
    SimulationDifference,
    TableBlock,
    headings,
)
from ring_cars.streams import ROAD

POINTS_MAX = 500
Lines = dict[str, tuple[Floats, Floats]]


def figures(run: RecordedRun) -> list[Section]:
    """Return the chapter of the ring road."""
    return build_sections({"host_road": Chapter("Ring road", road_blocks, ROAD)}, run)


def compare(a: ComparedRun, b: ComparedRun) -> SimulationDifference:
    """Return the mean speed of each car in both runs, and of all cars over time."""
    of_a, of_b = (_mean_speeds_m_s(one.run) for one in (a, b))
    over_time = [
        Series(x=x, y=y, name=f"{name}, car {car}")
        for name, one in (("first", a), ("second", b))
        for car, (x, y) in _speeds_m_s(one.run).items()
    ]
    rows = [[car, of_a.get(car), of_b.get(car)] for car in dict.fromkeys((*of_a, *of_b))]
    return SimulationDifference(
        document={"mean_speed_m_s": {str(car): [first, second] for car, first, second in rows}},
        blocks=[
            TableBlock(
                title="Mean speeds of cars",
                headings=headings("car", "first, m/s", "second, m/s"),
                rows=rows,
            ),
            *_speed_figure(over_time),
        ],
    )


def _speed_figure(marks: list[Series]) -> list[Figure]:
    y = Axis(quantity="speed", unit="m/s", from_zero=True)
    choices = [FigureChoice(marks=marks)]
    return [Figure(title="Speeds of both runs", y=y, choices=choices)] if marks else []


def road_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return trajectories, gaps, and a table of both."""
    driven, speeds, gaps = (
        run.series(table, name)[0] for name in ("driven_m", "speed_m_s", "gap_m")
    )
    return [
        _figure("Trajectories of all cars", driven, Axis(quantity="driven", unit="m")),
        _figure(
            "Gaps to the car ahead",
            gaps,
            Axis(unit="m", from_zero=True),
            limits=[LimitLine(value=0.0, name="collision", is_least=True)],
        ),
        TableBlock(
            title="Cars",
            headings=headings("car", "mean speed, m/s", "smallest gap, m"),
            rows=[
                [car, round(float(y.mean()), 3), round(float(gaps[car][1].min()), 3)]
                for car, (_, y) in speeds.items()
            ],
        ),
    ]


def _figure(title: str, lines: Lines, y: Axis, limits: list[LimitLine] | None = None) -> Figure:
    marks = []
    for name, (x, values) in lines.items():
        shown = evenly(len(x), POINTS_MAX)
        marks.append(Series(x=x[shown], y=values[shown], name=name))
    return Figure(title=title, y=y, choices=[FigureChoice(marks=marks)], limits=limits or ())


def _speeds_m_s(run: RecordedRun) -> Lines:
    table = run.tables.get("host_road")
    if table is None or not table.has("speed_m_s", "agent"):
        return {}
    return run.series(table, "speed_m_s")[0]


def _mean_speeds_m_s(run: RecordedRun) -> dict[str, float]:
    found = _speeds_m_s(run)
    return {car: round(float(np.mean(y)), 6) for car, (_, y) in found.items() if len(y)}
