"""What a report is made of: sections of figures, tables and remarks, for HTML and terminal alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from madns_runtime.recording.records import Field

Trace = dict[str, Any]
"""One trace as plotly.js takes it; numbers are numpy arrays until the page is written."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """One of several views of a figure, such as a group of agents or a satellite."""

    name: str
    traces: Sequence[Trace]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One figure. Drawn are thinned samples; every number told beside it is made of all of them."""

    title: str
    note: str = ""
    choices: Sequence[Choice]
    layout: Mapping[str, Any] = field(default_factory=dict)
    height_px: int = 300
    is_square: bool = False
    """Whether it is never higher than the page is wide, as a scene that would else be cut off."""
    group: str = ""
    """Figures of one group, such as satellite, change their choice together."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Remark:
    """A sentence where a figure would say nothing."""

    text: str


Block = Figure | TableBlock | Remark


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One chapter of a report."""

    title: str
    blocks: Sequence[Block]
    intro: str = ""


def headings(first: str, *numbers: str) -> tuple[Heading, ...]:
    """Return the heads of a table whose first column names things and whose others are numbers."""
    return (Heading(text=first, is_number=False), *(Heading(text=text) for text in numbers))


def title_of(field: Field) -> str:
    """Return a field's name in words, without the unit that ends it: that stands at the axis."""
    unit = field.unit.lower().replace("^", "").translate(str.maketrans("/ ", "__"))
    return field.name.removesuffix(f"_{unit}").replace("_", " ")


def format_cell(value: object) -> str:
    """Return a cell as text: four significant figures, whole numbers in full, a dash for nothing."""
    if value is None or (isinstance(value, float) and value != value):  # noqa: PLR0124 - NaN
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if isinstance(value, float):
        return _format_float(value)
    return str(value)


def _format_float(value: float) -> str:
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.3g}"
    if abs(value) >= 1000:
        return f"{value:.1f}"
    return f"{value:.4g}"
