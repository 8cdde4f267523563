"""Figures as plotly.js takes them: one renderer of the values in `madns_runtime.analysis.values`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np

from cosmos_cli.report.lettering import PLOT_PX, band_names, name_axis, names_px
from cosmos_cli.report.plotly_space import space_layout, space_traces
from cosmos_cli.report.style import (
    ACCENT,
    BAD,
    GRID,
    MUTED,
    PALETTE,
    TONES,
    axis,
    base_layout,
    grid_layout,
    log_axis,
)
from madns_runtime.analysis.sampling import broken_at_gaps
from madns_runtime.analysis.values import (
    SIMULATED_TIME,
    Axis,
    Band,
    Bars,
    Figure,
    FigureChoice,
    Floats,
    HeatMap,
    Histogram,
    Mark,
    Series,
    SpaceFigure,
    Tone,
)

Trace = dict[str, Any]
"""One trace as plotly.js takes it; numbers are numpy arrays until the page is written."""
NAMES_SHOWN_MAX = 40
LONE_PX = 5
"""Diameter of a value that no line goes to."""
WHOLE_MAX = 6
"""Whole numbers up to this one each have a line: there is no half a tick."""
HEIGHT_PX, BARS_HEIGHT_PX, SPACE_HEIGHT_PX = 300, 240, 560
ROW_PX, ROW_ALONE_PX = 190, 200


@dataclass(frozen=True, slots=True, kw_only=True)
class PlotlyFigure:
    """Traces of each choice, the layout of all, and the height on the page."""

    choices: list[tuple[str, list[Trace]]]
    layout: dict[str, Any]
    height_px: int = HEIGHT_PX
    is_square: bool = False
    """Whether it is never higher than the page is wide, as a scene that would else be cut off."""


def to_plotly(figure: Figure | SpaceFigure) -> PlotlyFigure:
    """Return a figure as plotly.js takes it."""
    if isinstance(figure, SpaceFigure):
        return PlotlyFigure(
            choices=[("", space_traces(figure))],
            layout=space_layout(figure),
            height_px=SPACE_HEIGHT_PX,
            is_square=True,
        )
    layout, height_px = _grid(figure) if figure.panels else _plain(figure)
    has_bars = any(isinstance(mark, Bars | Histogram) for mark in _marks(figure))
    if has_bars:
        layout["barmode"] = "stack"
    layout["showlegend"] = not (figure.panels and has_bars) and any(
        getattr(mark, "name", "") for mark in _marks(figure)
    )
    if figure.panels and layout["showlegend"]:
        layout["margin"] = {"l": 64, "r": 16, "t": 70, "b": 44}
        # Between the mode bar and the titles.
        layout["legend"] |= {"yref": "container", "y": 1 - 28 / height_px, "yanchor": "top"}
    return PlotlyFigure(
        choices=[(choice.name, list(_traces(figure, choice))) for choice in figure.choices],
        layout=layout,
        height_px=height_px,
    )


def _marks(figure: Figure) -> Iterator[Mark]:
    return (mark for choice in figure.choices for mark in choice.marks)


def _plain(figure: Figure) -> tuple[dict[str, Any], int]:
    marks = list(_marks(figure))
    bars = [mark for mark in marks if isinstance(mark, Bars)]
    histograms = [mark for mark in marks if isinstance(mark, Histogram)]
    x = axis(figure.x.label, showgrid=False)
    if figure.x.is_logarithmic:
        x |= log_axis(*_positive_range(map(_abscissae, marks)))
    height_px = HEIGHT_PX
    if bars:
        x |= name_axis(_bar_names(bars), names_max=NAMES_SHOWN_MAX)
        height_px = BARS_HEIGHT_PX + names_px(x, _bar_names(bars))
    layout = base_layout(xaxis=x, yaxis=_ordinate(figure.y, marks))
    if histograms:
        layout |= {"bargap": 0.05}
    if bars and _highest(bars) <= WHOLE_MAX:
        layout["yaxis"] |= {"dtick": 1}
    if figure.is_to_scale:
        layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    layout["shapes"] = [*_bands(figure), *_limit_lines(figure)]
    return layout, height_px


def _highest(bars: Sequence[Bars]) -> float:
    """Return the height of the highest bar, of those that stand on each other together."""
    heights: dict[str, float] = {}
    for mark in bars:
        for name, value in zip(mark.names, mark.values, strict=True):
            heights[name] = heights.get(name, 0.0) + (value or 0.0)
    return max(heights.values(), default=0.0)


def _ordinate(y: Axis, marks: Sequence[Mark]) -> dict[str, Any]:
    """Return the axis of values; its quantity is told by the title where it has a unit."""
    made = axis(y.unit or y.quantity)
    if y.is_logarithmic:
        made |= log_axis(*_positive_range(map(_ordinates, marks)))
    if y.from_zero:
        made |= {"rangemode": "tozero"}
    return made


def _grid(figure: Figure) -> tuple[dict[str, Any], int]:
    count, marks = len(figure.panels), list(_marks(figure))
    layout, height_px = grid_layout(
        [panel.label for panel in figure.panels],
        columns=figure.columns,
        row_px=ROW_ALONE_PX if figure.columns == 1 else ROW_PX,
        x_title=figure.x.label,
    )
    names_height_px = 0
    layout["shapes"] = []
    for index, panel in enumerate(figure.panels):
        number = index + 1
        inside = [mark for mark in marks if mark.panel == index]
        layout[f"yaxis{number}"] |= _ordinate(panel, inside) | {"title": {"text": ""}}
        names = _bar_names([mark for mark in inside if isinstance(mark, Bars)])
        if names:
            # The charts stand in columns over the same names: the lowest one's serve all.
            is_lowest = number + figure.columns > count
            level_px = 0.9 * PLOT_PX / figure.columns
            x = name_axis(names, names_max=NAMES_SHOWN_MAX, level_px=level_px)
            is_shown = is_lowest and len(names) <= NAMES_SHOWN_MAX
            layout[f"xaxis{number}"] |= {**x, "showticklabels": is_shown}
            if is_shown:
                names_height_px = max(names_height_px, names_px(x, names))
            layout[f"yaxis{number}"] |= {"rangemode": "tozero"}
        else:  # names are no time
            layout["shapes"] += _bands(figure, panel=index)
        layout["shapes"] += _limit_lines(figure, panel=index)
    return layout, height_px + names_height_px


def _bar_names(bars: Sequence[Bars]) -> list[str]:
    return list(dict.fromkeys(name for mark in bars for name in mark.names))


def _band_names(figure: Figure) -> list[str]:
    """Return the name that is written at each of a figure's event bands; empty for none."""
    edges = np.array([[event.start, event.end] for event in figure.events], dtype=np.float64)
    drawn = np.concatenate([edges.ravel(), *map(_abscissae, _marks(figure))])
    drawn = drawn[np.isfinite(drawn)]
    low, high = (float(drawn.min()), float(drawn.max())) if len(drawn) else (0.0, 1.0)
    return band_names(figure.events, low, high, PLOT_PX / (figure.columns if figure.panels else 1))


def _bands(figure: Figure, *, panel: int | None = None) -> list[dict[str, Any]]:
    """Return the event bands behind a figure's marks or, in the *panel*-th, behind that panel's."""
    number = panel + 1 if panel else ""
    refs = (
        {"yref": "paper"} if panel is None else {"xref": f"x{number}", "yref": f"y{number} domain"}
    )
    shapes = []
    for event, name in zip(figure.events, _band_names(figure), strict=True):
        place = {**refs, "x0": event.start, "x1": event.end, "y0": 0, "y1": 1}
        look = {"fillcolor": TONES.get(event.tone, MUTED), "opacity": 0.2, "line": {"width": 0}}
        label = {} if panel else _label(name, "top left")
        shapes.append({"type": "rect", "layer": "below", **place, **look, **label})
    return shapes


def _limit_lines(figure: Figure, *, panel: int | None = None) -> list[dict[str, Any]]:
    """Return the limits that lie in what is drawn, in any choice: of a figure or, in the *panel*-th, of that panel."""
    marks = [mark for mark in _marks(figure) if mark.panel == (panel or 0)]
    number = panel + 1 if panel else ""
    shapes = []
    for limit in figure.limits:
        if not limit.is_of_x and limit.panel != (panel or 0):
            continue
        values = [(_abscissae if limit.is_of_x else _ordinates)(mark) for mark in marks]
        seen = np.concatenate([np.empty(0), *values])
        if not np.isfinite(seen).any() or not np.nanmin(seen) <= limit.value <= np.nanmax(seen):
            continue
        along, across = ("y", "x") if limit.is_of_x else ("x", "y")
        ref = "paper" if panel is None else f"{along}{number} domain"
        place = {f"{along}ref": ref, f"{along}0": 0, f"{along}1": 1}
        place |= {f"{across}0": limit.value, f"{across}1": limit.value}
        if panel is not None:
            place[f"{across}ref"] = f"{across}{number}"
        line = {"width": 1, "dash": "dot", "color": BAD}
        name = "" if limit.is_of_x and panel else limit.name
        shapes.append({"type": "line", **place, "line": line, **_label(name, "end")})
    return shapes


def _label(text: str, place: str) -> dict[str, Any]:
    return (
        {"label": {"text": text, "font": {"size": 11, "color": MUTED}, "textposition": place}}
        if text
        else {}
    )


def _traces(figure: Figure, choice: FigureChoice) -> Iterator[Trace]:
    shown: set[str] = set()
    counts: dict[int, int] = {}
    for mark in choice.marks:
        place = counts.get(mark.panel, 0)
        counts[mark.panel] = place + 1
        for trace in _drawn(mark, place, figure):
            if figure.panels:
                number = mark.panel + 1
                trace |= {"xaxis": f"x{number}", "yaxis": f"y{number}"}
                trace["name"] = trace.get("name") or figure.panels[mark.panel].label
                trace["showlegend"] = trace["name"] not in shown and trace.get("showlegend", True)
                shown.add(trace["name"])
            yield trace


@singledispatch
def _drawn(mark: Mark, place: int, figure: Figure) -> list[Trace]:
    """Return the traces of a mark that is the *place*-th of its panel."""
    raise TypeError(f"expected a mark, got {type(mark).__name__}")


@_drawn.register
def _(mark: Series, place: int, figure: Figure) -> list[Trace]:
    if figure.x.quantity == SIMULATED_TIME.quantity:
        mark = broken_at_gaps(mark)
    colour = _colour(mark.tone, place)
    made: Trace = {
        "type": "scatter",
        "mode": {"points": "markers", "joined points": "lines+markers"}.get(mark.form, "lines"),
        "name": mark.name,
        "x": mark.x,
        "y": mark.y,
        "line": {"width": 1.3 if mark.tone == "palette" else 1.6, "color": colour},
    }
    if mark.tone == "palette":
        made["opacity"] = 0.85
    if mark.form == "dotted":
        made["line"]["dash"] = "dot"
    if mark.form == "steps":
        made["line"]["shape"] = "hv"
    if "points" not in mark.form and (is_lone := _lone(mark.y)).any():
        # A line through one value alone has no length.
        made["mode"] = "lines+markers"
        made["marker"] = {"size": np.where(is_lone, LONE_PX, 0.0), "color": colour}
    if "points" in mark.form:
        made["marker"] = {"size": 5 if mark.form == "points" else 4, "color": colour}
        if (is_bad := _broken(figure, mark.panel, mark.x, mark.y)).any():
            made["marker"]["color"] = np.where(is_bad, BAD, colour).tolist()
    if mark.note:
        made["hovertemplate"] = (
            f"%{{x:.6g}}: %{{y:.3g}} {figure.y.unit}, {mark.note}<extra></extra>"
        )
    return [made]


@_drawn.register
def _(mark: Band, place: int, figure: Figure) -> list[Trace]:
    edge = {"width": 0, "color": _colour(mark.tone, place)}
    low: Trace = {"type": "scatter", "mode": "lines", "x": mark.x, "y": mark.low, "line": edge}
    high = low | {"y": mark.high, "name": mark.name, "fill": "tonexty"}
    return [low | {"showlegend": False, "hoverinfo": "skip"}, high]


@_drawn.register
def _(mark: Histogram, place: int, figure: Figure) -> list[Trace]:
    middles = (mark.edges[1:] + mark.edges[:-1]) / 2
    colour = _colour(mark.tone, place)
    is_bad = _broken(figure, mark.panel, middles, mark.counts)
    unit = f" {figure.x.unit}" if figure.x.unit else ""
    told = "%{fullData.name}" if mark.name else figure.y.quantity
    return [
        {
            "type": "bar",
            "name": mark.name,
            "x": middles,
            "y": mark.counts,
            "width": np.diff(mark.edges),
            "marker": {"color": np.where(is_bad, BAD, colour).tolist() if is_bad.any() else colour},
            "showlegend": bool(mark.name),
            "hovertemplate": f"%{{x:.3g}}{unit}: %{{y:.0f}} {told}<extra></extra>",
        }
    ]


@_drawn.register
def _(mark: Bars, place: int, figure: Figure) -> list[Trace]:
    told = " %{fullData.name}" if mark.name else ""
    return [
        {
            "type": "bar",
            "name": mark.name,
            "x": list(mark.names),
            "y": list(mark.values),
            "marker": {"color": _colour(mark.tone, place)},
            "showlegend": bool(mark.name),
            "hovertemplate": f"%{{x}}: %{{y:.4g}}{told}<extra></extra>",
        }
    ]


@_drawn.register
def _(mark: HeatMap, place: int, figure: Figure) -> list[Trace]:
    return [
        {
            "type": "heatmap",
            "x": mark.x,
            "y": mark.y,
            "z": [row.tolist() for row in mark.values],
            "colorscale": [[0, GRID], [1, ACCENT]],
            "colorbar": {"title": {"text": mark.scale.label}},
        }
    ]


def _colour(tone: Tone, place: int) -> str:
    if tone != "palette":
        return TONES[tone]
    return PALETTE[place % len(PALETTE)]


def _broken(figure: Figure, panel: int, x: Floats, y: Floats) -> Any:
    """Tell which points of a panel lie beyond a limit."""
    is_bad = np.zeros(len(x), dtype=np.bool_)
    for limit in figure.limits:
        if limit.is_of_x or limit.panel == panel:
            is_bad |= limit.is_broken_by(x if limit.is_of_x else y)
    return is_bad


def _lone(y: Floats) -> Any:
    """Tell which values have none beside them, shape (N,)."""
    is_there = np.pad(np.isfinite(y), 1)
    return is_there[1:-1] & ~is_there[:-2] & ~is_there[2:]


def _abscissae(mark: Mark) -> Floats:
    if isinstance(mark, Histogram):
        return mark.edges
    return np.empty(0) if isinstance(mark, Bars) else mark.x


def _ordinates(mark: Mark) -> Floats:
    if isinstance(mark, Histogram):
        return mark.counts
    if isinstance(mark, Bars):
        return np.array(mark.values, dtype=np.float64)
    return np.concatenate((mark.low, mark.high)) if isinstance(mark, Band) else mark.y


def _positive_range(arrays: Iterator[Floats]) -> tuple[float, float]:
    every = np.concatenate([np.empty(0), *arrays])
    positive = every[np.isfinite(every) & (every > 0.0)]
    return (float(positive.min()), float(positive.max())) if len(positive) else (1.0, 10.0)
