"""Style of figures: colours and axes, as plotly.js takes them. Calm, light, printable."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from madns_runtime.analysis.values import Tone

INK, MUTED, GRID = "#1f2933", "#667085", "#e9edf2"
ACCENT, WARM, BAD = "#2b5c8a", "#c4692b", "#b42318"
PALETTE = ("#2b5c8a", "#c4692b", "#3d8361", "#7d5a9b", "#b08c2e")
"""Five that stay apart on paper and for most colour-blind eyes: a group of agents is five, as in the thesis."""
TONES: Mapping[Tone, str] = {
    "main": ACCENT,
    "warm": WARM,
    "bad": BAD,
    "pale": "#e2a49a",
    "muted": MUTED,
}
DECADES_FINE_MAX = 3
FONT = "Inter, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif"


def axis(title: str = "", **more: Any) -> dict[str, Any]:
    """Return an axis with the house's lines and lettering."""
    return {
        "title": {"text": title, "standoff": 8, "font": {"size": 12, "color": MUTED}},
        "gridcolor": GRID,
        "linecolor": "#cbd2d9",
        "zeroline": False,
        "exponentformat": "power",
        "minexponent": 7,
        "separatethousands": True,
        "tickfont": {"size": 11, "color": MUTED},
        "automargin": True,
        **more,
    }


def base_layout(**more: Any) -> dict[str, Any]:
    """Return what all figures share."""
    return {
        "font": {"family": FONT, "size": 12, "color": INK},
        # Above the plot: the mode bar, and below it the legend or the titles of a grid.
        "margin": {"l": 60, "r": 16, "t": 48, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "hovermode": "closest",
        "legend": {
            "orientation": "h",
            "y": 1.02,
            "yanchor": "bottom",
            "x": 0,
            "font": {"size": 11},
        },
        "bargap": 0.25,
        "separators": ".\u202f",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#b3bfcc", "activecolor": ACCENT},
        **more,
    }


def log_axis(low: float, high: float) -> dict[str, Any]:
    """
    Return what makes an axis logarithmic.

    Ticks stand at 1, 2, 5 of each decade if there are few decades, else at 1; plotly's own would show
    a 200 as a small 2. Between values so close that fewer than two of those lie there they stand evenly.
    """
    first = math.floor(math.log10(max(low, 1e-12)))
    last = min(math.ceil(math.log10(max(high, 1e-12))), sys.float_info.max_10_exp)
    steps = (1, 2, 5) if last - first <= DECADES_FINE_MAX else (1,)
    ticks = [step * 10.0**decade for decade in range(first, last + 1) for step in steps]
    ticks = [tick for tick in ticks if tick < math.inf]
    is_short = sum(low <= tick <= high for tick in ticks) < 2
    if is_short and (high - low) / 2 > sys.float_info.min:
        ticks = _even_ticks(low, high)
    return {"type": "log", "tickvals": ticks, "ticktext": [f"{tick:.10g}" for tick in ticks]}


def _even_ticks(low: float, high: float) -> list[float]:
    """Return round numbers between two that are less than three apart by their ratio, at least two of them."""
    step = 10.0 ** math.floor(math.log10((high - low) / 2))
    step *= next(factor for factor in (5, 2, 1) if factor * step <= (high - low) / 2)
    first, last = math.ceil(low / step), math.floor(high / step)
    return [number * step for number in range(first, last + 1)]


def grid_layout(
    titles: Sequence[str], *, columns: int, row_px: int, x_title: str
) -> tuple[dict[str, Any], int]:
    """Return the layout of a grid of plots, axes numbered from 1 row by row, and its height in pixels."""
    rows = -(-len(titles) // columns)
    gap_x, gap_y = 0.09, 0.32 / max(rows, 1) if rows > 1 else 0.0
    width, height = (1 - gap_x * (columns - 1)) / columns, (1 - gap_y * (rows - 1)) / rows
    result = base_layout(showlegend=False, annotations=[])
    for index, title in enumerate(titles):
        row, column = divmod(index, columns)
        x0, y1 = column * (width + gap_x), 1 - row * (height + gap_y)
        bottom = index + columns >= len(titles)
        number = index + 1
        result[f"xaxis{number}"] = axis(
            x_title if bottom else "", domain=[x0, x0 + width], anchor=f"y{number}", showgrid=False
        )
        result[f"yaxis{number}"] = axis(domain=[max(y1 - height, 0), y1], anchor=f"x{number}")
        result["annotations"].append(_plot_title(title, x0, y1))
    return result, 78 + rows * row_px


def _plot_title(text: str, x: float, y: float) -> dict[str, Any]:
    return {
        "text": text,
        "xref": "paper",
        "yref": "paper",
        "x": x,
        "y": y,
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 12, "color": INK},
    }
