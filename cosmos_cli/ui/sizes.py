"""Sizes of files and disks in words."""

from __future__ import annotations

from typing import Final

KILO: Final = 1000.0
UNITS: Final = ("kB", "MB", "GB", "TB")
ROUNDED_UP: Final = 999.95
"""A size that one decimal would show as 1000.0 is told in the next unit."""


def size_words(size_bytes: float) -> str:
    """Return a size for people, such as 17 B, 1.2 kB or 340.5 MB."""
    if size_bytes < KILO:
        return f"{size_bytes:.0f} B"
    size, power = size_bytes / KILO, 1
    while size >= ROUNDED_UP and power < len(UNITS):
        size, power = size / KILO, power + 1
    return f"{size:.1f} {UNITS[power - 1]}"
