"""Comparisons as one self-contained HTML file, with the figures that their simulation draws."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from cosmos_cli.diff.blocks import blocks_of
from cosmos_cli.diff.compare import Comparison
from cosmos_cli.diff.terminal import heading_lines, verdict_of
from cosmos_cli.report.html import render_sections
from madns_runtime.analysis.values import Section
from madns_runtime.partial_file import write_whole


def write_comparisons(comparisons: Sequence[Comparison], path: Path) -> None:
    """
    Write the page of comparisons with one and the same run.

    Raises:
        OSError: The file cannot be written.
    """
    write_whole(path, render_comparisons(comparisons).encode())


def render_comparisons(comparisons: Sequence[Comparison]) -> str:
    """Return the whole page."""
    first = comparisons[0].a.run.name
    others = ", ".join(found.b.run.name for found in comparisons)
    return render_sections(
        "comparison.html",
        [section for found in comparisons for section in _sections(found)],
        title=f"{first} and {others}",
        comparisons=[
            {
                "is_same": found.is_same,
                "verdict": verdict_of(found),
                "lines": heading_lines(found),
            }
            for found in comparisons
        ],
    )


def _sections(found: Comparison) -> Iterator[Section]:
    names = f"A {found.a.run.name}, B {found.b.run.name}"
    yield Section(title=names, blocks=list(blocks_of(found)))
    if found.by_simulation is not None:
        yield Section(title=f"{found.simulation}: {names}", blocks=found.by_simulation.blocks)
