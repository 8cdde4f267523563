"""`cosmos bench`: floors of machines, the thesis's benchmark with its tables, and how many agents fit."""

from __future__ import annotations

SUBCOMMANDS = ("floor", "suite", "capacity")


def bench() -> None:
    """Measure: what machines allow (floor), the thesis's benchmark (suite), how many agents fit (capacity)."""
