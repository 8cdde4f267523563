"""
Texts within figures that share their room: names below bars, names of event bands. Pure.

plotly.js lays such texts on each other where they do not fit; widths are estimated for the page's full width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from madns_runtime.analysis.values import EventBand

CHARACTER_PX = 5.5
"""Mean width of a character of 11 px, the size of all texts here."""
PLOT_PX = 916
"""Width of what is drawn in a figure, without its margins, on a page of full width."""
GAP_PX = 8
"""Room between two texts."""
UPRIGHT_PX = 70
"""Room that figures have below their bars for upright names."""
NAME_CHARACTERS_MAX = 24
BAND_CHARACTERS_MAX = 48


def text_px(text: str) -> float:
    """Return the estimated width of a text with the room beside it, px."""
    return len(text) * CHARACTER_PX + GAP_PX


def shortened(text: str, characters_max: int) -> str:
    """Return a text of at most so many characters, cut in its middle: names differ at either end."""
    if len(text) <= characters_max:
        return text
    tail = characters_max // 2
    return f"{text[: characters_max - tail - 1]}…{text[-tail:]}"


def name_axis(
    names: Sequence[str], *, names_max: int, level_px: float | None = None
) -> dict[str, Any]:
    """
    Return the axis of names below bars.

    Args:
        names: The names, in the order of the bars.
        names_max: Largest number of names shown.
        level_px: Width for level names, px; None to have all stand upright.
    """
    width_px = max(map(text_px, names), default=0.0) * len(names)
    is_level = level_px is not None and width_px <= level_px
    made: dict[str, Any] = {"type": "category", "tickangle": 0 if is_level else -90}
    if any(len(name) > NAME_CHARACTERS_MAX for name in names):
        told = list(names[:: -(-len(names) // names_max)])
        made["tickvals"] = told
        made["ticktext"] = [shortened(name, NAME_CHARACTERS_MAX) for name in told]
    return made


def names_px(axis: Mapping[str, Any], names: Sequence[str]) -> int:
    """Return how much higher a figure is to be for the names below its bars, px: upright ones take room from them."""
    if not axis["tickangle"]:
        return 0
    longest = max(map(text_px, axis.get("ticktext", names)), default=0.0)
    return max(0, round(longest - UPRIGHT_PX))


def band_names(bands: Sequence[EventBand], low: float, high: float, width_px: float) -> list[str]:
    """
    Return the name that is written at each band; empty where it would lie on another's.

    Longer bands come first: what lasted matters more than what was noted.

    Args:
        bands: The bands.
        low: Least abscissa drawn.
        high: Largest abscissa drawn.
        width_px: Width of what is drawn, px.
    """
    told = [""] * len(bands)
    taken: list[tuple[float, float]] = []
    unit_px = width_px / max(high - low, 1e-300)
    order = sorted(range(len(bands)), key=lambda i: (bands[i].start - bands[i].end, i))
    for index in order:
        text = shortened(bands[index].name, BAND_CHARACTERS_MAX)
        start_px = (bands[index].start - low) * unit_px
        end_px = start_px + text_px(text)
        if text and all(end_px <= start or start_px >= end for start, end in taken):
            taken.append((start_px, end_px))
            told[index] = text
    return told
