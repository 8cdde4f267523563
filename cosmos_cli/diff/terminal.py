"""A comparison for a person: what differs, first in words, then in tables."""

from __future__ import annotations

from collections.abc import Iterable

from cosmos_cli.diff.blocks import blocks_of
from cosmos_cli.diff.compare import Comparison
from cosmos_cli.report.cells import format_cell
from cosmos_cli.report.terminal import verdict_line
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.plural import counted
from madns_runtime.analysis.values import Block, ReportRemark, TableBlock


def print_comparison(console: Console, found: Comparison) -> None:
    """Print a comparison on stdout; its last line says whether the runs are the same."""
    for line in heading_lines(found):
        console.data(line)
    _print_blocks(console, blocks_of(found))
    if found.by_simulation is not None:
        _print_blocks(console, found.by_simulation.blocks, before_remark="remark: ")
    console.data("")
    console.data(verdict_of(found))


def heading_lines(found: Comparison) -> list[str]:
    """Return the lines about the two runs as wholes: their verdicts, and what spoils the comparison."""
    names = (found.a.run.name, found.b.run.name)
    return [
        verdict_line(f"A  {names[0]}", found.a.document),
        verdict_line(f"B  {names[1]}", found.b.document),
        *(f"missing: {line}" for line in found.missing),
        *(f"remark: {line}" for line in found.remarks),
    ]


def verdict_of(found: Comparison) -> str:
    """Return in one line whether the compared records are the same."""
    records = counted(sum(one.matched for one in found.streams), "record")
    sources = counted(len(found.streams), "stream")
    if found.is_identical:
        return f"IDENTICAL: {records} of {sources} are the same bit by bit"
    if found.is_same:
        return f"SAME: {records} of {sources} hold the same values"
    if not found.has_records:
        return "NOTHING COMPARED: neither run has a record that was chosen"
    tables = [one.table for one in found.totals() if not (one.is_identical or one.has_same_values)]
    reasons = [f"records differ in {', '.join(tables)}"] if tables else []
    for name, keys in (("A", found.only_a), ("B", found.only_b)):
        if keys:
            reasons.append(f"{counted(len(keys), 'stream')} only in {name}")
    if found.missing:
        reasons.append("data are missing")
    return f"DIFFERENT: {'; '.join(reasons)}"


def count_figures(found: Comparison) -> int:
    """Return how many blocks of a comparison no terminal shows."""
    blocks = found.by_simulation.blocks if found.by_simulation is not None else ()
    return sum(not isinstance(block, ReportRemark | TableBlock) for block in blocks)


def _print_blocks(console: Console, blocks: Iterable[Block], before_remark: str = "") -> None:
    is_after_table = False
    for block in blocks:
        if isinstance(block, ReportRemark):
            if is_after_table:
                console.data("")
            is_after_table = False
            console.data(f"{before_remark}{block.text}")
        elif isinstance(block, TableBlock):
            is_after_table = True
            console.data(f"\n{block.title}" if block.title else "")
            columns = [Column(h.text, is_number=h.is_number) for h in block.headings]
            console.table(columns, [[format_cell(cell) for cell in row] for row in block.rows])
            if block.note:
                console.data(block.note)
