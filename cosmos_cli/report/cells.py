"""Cells of tables as text, for HTML and terminal alike."""

from __future__ import annotations


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


def format_measured(value: object, limit: object) -> str:
    """Return what was measured as a cell beside its limit: in all digits where they would look the same and are not."""
    if value is None:
        return "not measured"
    text = format_cell(value)
    is_told_apart = text != format_cell(limit) or value == limit
    return text if is_told_apart or not isinstance(value, float) else repr(value)


def _format_float(value: float) -> str:
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.3g}"
    if abs(value) >= 1000:
        return f"{value:.1f}"
    return f"{value:.4g}"
