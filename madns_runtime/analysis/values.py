"""
Values of figures, tables and remarks, free of any plotting library.

Every array is one of float64; what does not fit together is refused where it is made, so that an error names the
line that made it. Texts are shown as they are: markup in them is none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.field_checks import (
    as_number,
    hold_arrays,
    hold_kind,
    hold_list,
    hold_numbers,
    hold_same,
    hold_texts,
    hold_whole,
    hold_word,
    table_rows,
)

Floats = NDArray[np.float64]
Tone = Literal["palette", "main", "warm", "bad", "pale", "muted"]
"""Colour by meaning; palette: by the place among a figure's marks."""
Form = Literal["line", "dotted", "steps", "points", "joined points"]
"""How values are joined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One axis of a figure."""

    quantity: str = ""
    """Empty where the figure's title says it."""
    unit: str = ""
    is_logarithmic: bool = False
    from_zero: bool = False
    """Whether zero is shown in any case."""

    def __post_init__(self) -> None:
        """Refuse what is no text."""
        hold_texts(self, "quantity", "unit")

    @property
    def label(self) -> str:
        """Quantity and unit."""
        return ", ".join(text for text in (self.quantity, self.unit) if text)


SIMULATED_TIME = Axis(quantity="simulated time", unit="s")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """Values over an abscissa, shape (N,) each; NaN is a gap, as is a hole in simulated times that else come regularly."""

    x: Floats
    y: Floats
    name: str = ""
    form: Form = "line"
    tone: Tone = "palette"
    panel: int = 0
    """Number of the figure's panel that it is in."""
    note: str = ""
    """Text beside each value when a reader points at it."""

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        hold_same(self, "x", "y")
        _hold_mark(self, "name", "note")
        hold_word(self, "form", get_args(Form))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Band:
    """A range of values over an abscissa, shape (N,) each."""

    x: Floats
    low: Floats
    high: Floats
    name: str = ""
    tone: Tone = "palette"
    panel: int = 0

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        hold_same(self, "x", "low", "high")
        _hold_mark(self, "name")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Histogram:
    """Counts between edges; several of one figure stand on each other."""

    edges: Floats
    """Shape (N + 1,), ascending."""
    counts: Floats
    """Shape (N,)."""
    name: str = ""
    tone: Tone = "main"
    panel: int = 0

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        hold_arrays(self, {"edges": 1, "counts": 1})
        edges, counts = len(self.edges), len(self.counts)
        if edges != counts + 1:
            raise ValueError(f"Histogram: expected one edge more than {counts} counts, got {edges}")
        if not np.all(self.edges[1:] >= self.edges[:-1]):
            raise ValueError("Histogram: expected edges that ascend, none of them NaN")
        _hold_mark(self, "name")


@dataclass(frozen=True, slots=True, kw_only=True)
class Bars:
    """One bar per name; None where there is no value. Several of one figure stand on each other."""

    names: Sequence[str]
    values: Sequence[float | None]
    name: str = ""
    """Of what the values are, where a figure has several."""
    tone: Tone = "main"
    panel: int = 0

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        hold_list(self, "names", str, "a text")
        hold_list(self, "values", object, "a number or None")
        if len(self.names) != len(self.values):
            raise ValueError(f"Bars: {len(self.names)} names and {len(self.values)} values")
        values = [None if v is None else as_number(v, "Bars.values") for v in self.values]
        object.__setattr__(self, "values", values)
        _hold_mark(self, "name")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeatMap:
    """Values over a plane, shape (len(y), len(x)); x and y are the cells' middles."""

    x: Floats
    y: Floats
    values: Floats
    scale: Axis
    """Quantity and unit of the values."""
    panel: int = 0

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        hold_arrays(self, {"x": 1, "y": 1, "values": 2})
        if self.values.shape != (len(self.y), len(self.x)):
            raise ValueError(
                f"HeatMap: expected values of shape {(len(self.y), len(self.x))}, got {self.values.shape}"
            )
        hold_kind(self, "scale", Axis, "an Axis")
        _hold_mark(self)


Mark = Series | Band | Histogram | Bars | HeatMap


def _hold_mark(mark: Mark, *texts: str) -> None:
    """Refuse what marks have in common where it is something else, and fields that are no texts."""
    hold_texts(mark, *texts)
    if not isinstance(mark, HeatMap):
        hold_word(mark, "tone", get_args(Tone))
    hold_whole(mark, "panel")


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitLine:
    """A value that should not be passed: what lies beyond is drawn as bad."""

    value: float
    name: str = ""
    is_least: bool = False
    """Whether smaller values are the bad ones."""
    is_of_x: bool = False
    """Whether it is one of the abscissa, which all panels have in common."""
    panel: int = 0

    def __post_init__(self) -> None:
        """Refuse what is no number or no text."""
        hold_numbers(self, "value")
        hold_texts(self, "name")
        hold_whole(self, "panel")

    def is_broken_by(self, values: Floats) -> NDArray[np.bool_]:
        """Tell which values lie beyond."""
        return values < self.value if self.is_least else values > self.value


@dataclass(frozen=True, slots=True, kw_only=True)
class EventBand:
    """A stretch of the abscissa in which something was the case."""

    start: float
    end: float
    name: str = ""
    tone: Tone = "warm"

    def __post_init__(self) -> None:
        """Refuse what is no number, no text or no tone."""
        hold_numbers(self, "start", "end")
        hold_texts(self, "name")
        hold_word(self, "tone", get_args(Tone))


@dataclass(frozen=True, slots=True, kw_only=True)
class FigureChoice:
    """One of several views of a figure, such as a group of agents or a satellite."""

    marks: Sequence[Mark]
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse what is no mark or no text."""
        hold_list(self, "marks", get_args(Mark), "a mark, such as a Series")
        hold_texts(self, "name")


FIGURE_LISTS = {
    "panels": Axis,
    "choices": FigureChoice,
    "limits": LimitLine,
    "events": EventBand,
}
"""Of what a figure has several."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One figure. Drawn are thinned samples; every number told beside it is made of all of them."""

    title: str
    note: str = ""
    x: Axis = SIMULATED_TIME
    y: Axis = Axis()
    panels: Sequence[Axis] = ()
    """Ordinates of several plots over one abscissa, in place of *y*; each bears its label as title."""
    columns: int = 2
    """Panels side by side."""
    choices: Sequence[FigureChoice]
    group: str = ""
    """Figures of one group, such as satellite, change their choice together."""
    is_to_scale: bool = False
    """Whether a unit is as long on both axes: a map."""
    limits: Sequence[LimitLine] = ()
    events: Sequence[EventBand] = ()

    def __post_init__(self) -> None:
        """Refuse a figure that shows nothing, other values in it, or marks in panels that are not there."""
        hold_texts(self, "title", "note", "group")
        hold_kind(self, "x", Axis, "an Axis")
        hold_kind(self, "y", Axis, "an Axis")
        for name, kind in FIGURE_LISTS.items():
            hold_list(self, name, kind, kind.__name__)
        hold_whole(self, "columns")
        if self.columns < 1:
            raise ValueError(f"figure {self.title!r}: expected columns, got {self.columns}")
        if not self.choices or not all(choice.marks for choice in self.choices):
            raise ValueError(
                f"figure {self.title!r}: expected a mark in each of at least one choice"
            )
        panels = max(len(self.panels), 1)
        inside = (*self.limits, *(mark for choice in self.choices for mark in choice.marks))
        wrong = {each.panel for each in inside} - set(range(panels))
        if wrong:
            raise ValueError(f"figure {self.title!r}: no panel {min(wrong)}; it has {panels}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpacePath:
    """A line in space, shape (N, 3); NaN is a gap."""

    points: Floats
    name: str = ""
    tone: Tone = "palette"
    is_background: bool = False
    """Whether it is thin and says nothing when pointed at."""

    def __post_init__(self) -> None:
        """Refuse what is no line in space."""
        hold_arrays(self, {"points": 2})
        if self.points.shape[1] != 3:
            raise ValueError(f"SpacePath: expected shape (N, 3), got {self.points.shape}")
        hold_texts(self, "name")
        hold_word(self, "tone", get_args(Tone))


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceFigure:
    """Lines in space, in one unit."""

    title: str
    note: str = ""
    unit: str
    paths: Sequence[SpacePath]
    spots: SpacePath | None = None
    """Points of their own."""
    spot_names: Sequence[str] = ()
    """One per spot."""
    sphere_radius: float | None = None
    """Of a body about the origin."""

    def __post_init__(self) -> None:
        """Refuse other values, and a sphere without an extent."""
        hold_texts(self, "title", "note", "unit")
        hold_list(self, "paths", SpacePath, "a SpacePath")
        hold_kind(self, "spots", (SpacePath, NoneType), "a SpacePath or None")
        hold_list(self, "spot_names", str, "a text")
        if self.sphere_radius is not None:
            hold_numbers(self, "sphere_radius")
            if not 0.0 < self.sphere_radius < math.inf:
                raise ValueError(
                    f"SpaceFigure.sphere_radius: expected more than 0, got {self.sphere_radius:g}"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class Heading:
    """The head of a table's column."""

    text: str
    is_number: bool = True

    def __post_init__(self) -> None:
        """Refuse what is no text."""
        hold_texts(self, "text")


@dataclass(frozen=True, slots=True, kw_only=True)
class TableBlock:
    """A table; cells are texts or numbers, None for what is not there."""

    title: str
    headings: Sequence[Heading]
    rows: Sequence[Sequence[object]]
    note: str = ""

    def __post_init__(self) -> None:
        """Turn arrays into rows; refuse a head of other values, and rows of another length than it."""
        hold_texts(self, "title", "note")
        hold_list(self, "headings", Heading, "a Heading")
        object.__setattr__(self, "rows", table_rows(self.rows, len(self.headings), self.title))


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportRemark:
    """A sentence where a figure would say nothing."""

    text: str

    def __post_init__(self) -> None:
        """Refuse what is no text."""
        hold_texts(self, "text")


Block = Figure | SpaceFigure | TableBlock | ReportRemark


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One chapter of a report."""

    title: str
    blocks: Sequence[Block]
    intro: str = ""
    tables: Sequence[str] = ()
    """Names of the tables that it tells of: they are not drawn again."""

    def __post_init__(self) -> None:
        """Refuse what is no text; blocks are looked at where they are shown."""
        hold_texts(self, "title", "intro")
        hold_list(self, "tables", str, "a table's name")


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationDifference:
    """Differences that a simulation finds between two runs of it."""

    document: Mapping[str, Any]
    """Part of `cosmos diff --json` under the simulation's name: plain values, units in their names."""
    blocks: Sequence[Block]
    """The same for a person: tables and remarks, and figures for the page that `cosmos diff --html` writes."""


def headings(first: str, *numbers: str) -> tuple[Heading, ...]:
    """Return the heads of a table whose first column names things and whose others are numbers."""
    return (Heading(text=first, is_number=False), *(Heading(text=text) for text in numbers))
