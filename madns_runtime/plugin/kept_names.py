"""Names that no simulation may have. Pure."""

from __future__ import annotations

from typing import Final

KEPT_NAMES: Final = (
    "schema",
    "runs",
    "simulation",
    "same",
    "identical",
    "settings",
    "versions",
    "summaries",
    "timing",
    "streams",
    "streams_only_a",
    "streams_only_b",
    "missing",
    "remarks",
)
"""Keys of a comparison as JSON, where what a simulation tells of itself stands under its name."""


def name_faults(name: str) -> list[str]:
    """Return what is wrong with the name of a descriptor, a text."""
    if name not in KEPT_NAMES:
        return []
    return [f"name: expected a text, none of {', '.join(KEPT_NAMES)}; got {name!r:.80}"]
