"""
Values of figures, tables and remarks, free of any plotting library.

Every array is one of float64; what does not fit together is refused where it is made, so that an error names the
line that made it. Texts are shown as they are: markup in them is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Tone = Literal["palette", "main", "warm", "bad", "pale", "muted"]
"""Colour by meaning; palette: by the place among a figure's marks."""


def _hold(owner: Any, shapes: Mapping[str, int]) -> None:
    """Turn fields of *owner* into arrays of so many dimensions."""
    for name, dimensions in shapes.items():
        array = np.asarray(getattr(owner, name), dtype=np.float64)
        if array.ndim != dimensions:
            raise ValueError(
                f"{type(owner).__name__}.{name}: expected {dimensions} dimensions, got {array.ndim}"
            )
        object.__setattr__(owner, name, array)


def _hold_same(owner: Any, *names: str) -> None:
    """Turn fields of *owner* into arrays of one dimension and one length."""
    _hold(owner, dict.fromkeys(names, 1))
    lengths = {name: len(getattr(owner, name)) for name in names}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"{type(owner).__name__}: expected one length, got {told}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One axis of a figure."""

    quantity: str = ""
    """Empty where the figure's title says it."""
    unit: str = ""
    is_logarithmic: bool = False
    from_zero: bool = False
    """Whether zero is shown in any case."""

    @property
    def label(self) -> str:
        """Quantity and unit."""
        return ", ".join(text for text in (self.quantity, self.unit) if text)


SIMULATED_TIME = Axis(quantity="simulated time", unit="s")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """Values over an abscissa, shape (N,) each; NaN is a gap."""

    x: Floats
    y: Floats
    name: str = ""
    form: Literal["line", "dotted", "steps", "points", "joined points"] = "line"
    tone: Tone = "palette"
    panel: int = 0
    """Number of the figure's panel that it is in."""
    note: str = ""
    """Text beside each value when a reader points at it."""

    def __post_init__(self) -> None:
        """Refuse what does not fit together."""
        _hold_same(self, "x", "y")


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
        _hold_same(self, "x", "low", "high")


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
        _hold(self, {"edges": 1, "counts": 1})
        if len(self.edges) != len(self.counts) + 1:
            raise ValueError(
                f"Histogram: expected one edge more than counts, got {len(self.edges)} edges"
                f" and {len(self.counts)} counts"
            )


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
        if len(self.names) != len(self.values):
            raise ValueError(f"Bars: {len(self.names)} names and {len(self.values)} values")


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
        _hold(self, {"x": 1, "y": 1, "values": 2})
        if self.values.shape != (len(self.y), len(self.x)):
            raise ValueError(
                f"HeatMap: expected values of shape {(len(self.y), len(self.x))}, got {self.values.shape}"
            )


Mark = Series | Band | Histogram | Bars | HeatMap


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitLine:
    """A value that should not be passed: what lies beyond is drawn as bad."""

    value: float
    name: str = ""
    is_least: bool = False
    """Whether smaller values are the bad ones."""
    is_of_x: bool = False
    """Whether it is one of the abscissa."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class FigureChoice:
    """One of several views of a figure, such as a group of agents or a satellite."""

    marks: Sequence[Mark]
    name: str = ""


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
        """Refuse a figure that shows nothing, or marks in panels that are not there."""
        if not self.choices or not all(choice.marks for choice in self.choices):
            raise ValueError(
                f"figure {self.title!r}: expected a mark in each of at least one choice"
            )
        panels = max(len(self.panels), 1)
        wrong = {m.panel for choice in self.choices for m in choice.marks} - set(range(panels))
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
        _hold(self, {"points": 2})
        if self.points.shape[1] != 3:
            raise ValueError(f"SpacePath: expected shape (N, 3), got {self.points.shape}")


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Heading:
    """The head of a table's column."""

    text: str
    is_number: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class TableBlock:
    """A table; cells are texts or numbers, None for what is not there."""

    title: str
    headings: Sequence[Heading]
    rows: Sequence[Sequence[object]]
    note: str = ""

    def __post_init__(self) -> None:
        """Refuse a head of other values, and rows of another length than it."""
        heads: Sequence[Any] = self.headings
        if wrong := [type(head).__name__ for head in heads if not isinstance(head, Heading)]:
            raise ValueError(f"table {self.title!r}: expected a Heading per column, got {wrong[0]}")
        for number, row in enumerate(self.rows):
            if len(row) != len(self.headings):
                raise ValueError(
                    f"table {self.title!r}: row {number} has {len(row)} cells, the head {len(self.headings)}"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportRemark:
    """A sentence where a figure would say nothing."""

    text: str

    def __post_init__(self) -> None:
        """Refuse what is no text."""
        text: Any = self.text
        if not isinstance(text, str):
            raise ValueError(f"ReportRemark: expected a text, got {type(text).__name__}")


Block = Figure | SpaceFigure | TableBlock | ReportRemark


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One chapter of a report."""

    title: str
    blocks: Sequence[Block]
    intro: str = ""
    tables: Sequence[str] = ()
    """Names of the tables that it tells of: they are not drawn again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationDifference:
    """Differences that a simulation finds between two runs of it."""

    document: Mapping[str, Any]
    """Part of `cosmos diff --json` under the simulation's name: plain values, units in their names."""
    blocks: Sequence[Block]
    """The same for a person: tables and remarks."""


def headings(first: str, *numbers: str) -> tuple[Heading, ...]:
    """Return the heads of a table whose first column names things and whose others are numbers."""
    return (Heading(text=first, is_number=False), *(Heading(text=text) for text in numbers))
