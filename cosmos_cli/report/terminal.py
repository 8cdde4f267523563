"""The report for a terminal: the verdict, the checks and the tables, no figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cosmos_cli.report.build import figures_of
from cosmos_cli.report.cells import format_cell, format_measured
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.analysis.values import ReportRemark, Section, TableBlock
from madns_runtime.plain_values import mapping_at

CHECK_COLUMNS = (
    Column("check"),
    Column("measured", is_number=True),
    Column("limit", is_number=True),
    Column(""),
    Column("worst"),
)


def print_report(
    console: Console, document: Mapping[str, Any], sections: Sequence[Section]
) -> None:
    """Print a run's report on stdout."""
    console.data(verdict_line(str(document.get("run")), document))
    console.data("")
    for name, value, remark in figures_of(document):
        console.data(f"  {name:<18}{value:>14}   {remark}")
    console.data("")
    console.table(CHECK_COLUMNS, [_check_row(check) for check in document.get("checks", ())])
    for line in document.get("remarks", ()):
        console.data(line)
    for line in mapping_at(document, "data").get("missing", ()):
        console.data(f"missing: {line}")
    for problem in document.get("problems", ()):
        console.data(f"problem: {problem.get('text')}")
    for section in sections:
        _print_section(console, section)


def verdict_line(name: str, document: Mapping[str, Any]) -> str:
    """Return the line of a run's verdict, as its document has it: somebody may have put more than a line there."""
    return clean_line(f"{name}: {document.get('verdict') or 'no verdict'}", length_max=None)


def _print_section(console: Console, section: Section) -> None:
    told = [block for block in section.blocks if isinstance(block, TableBlock | ReportRemark)]
    if not told:
        return
    console.data(f"\n{section.title}")
    if section.intro:
        console.data(section.intro)
    for block in told:
        if isinstance(block, ReportRemark):
            console.data(block.text)
            continue
        console.data(f"\n{block.title}")
        if block.note:  # such as how many rows there are beyond these
            console.data(block.note)
        columns = [Column(h.text, is_number=h.is_number) for h in block.headings]
        console.table(columns, [[format_cell(cell) for cell in row] for row in block.rows])


def _check_row(check: Mapping[str, Any]) -> list[str]:
    got = check.get("got")
    return [
        str(check.get("name")),
        format_measured(got, check.get("limit")),
        format_cell(check.get("limit")),
        "holds" if check.get("passed") is True else "BROKEN",
        str(check.get("worst") or ""),
    ]
