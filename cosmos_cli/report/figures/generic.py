"""Figures of streams that the report knows nothing of: a time series for each number."""

from __future__ import annotations

from collections.abc import Sequence

from cosmos_cli.report.figures.grouped import grouped_lines
from cosmos_cli.report.model import Block, Remark, title_of
from cosmos_cli.report.source import Source
from cosmos_cli.tables import TableReader

FIGURES_MAX = 12
TIME_FIELDS = ("t_s", "tick", "packet", "monotonic_s")


def generic_blocks(
    table: TableReader, source: Source, *, prefix: str = "", without: Sequence[str] = ()
) -> list[Block]:
    """Return one figure a numeric field, in the stream's order; titles begin with *prefix*."""
    if not table.rows:
        return [Remark(text=f"The stream {table.name} holds no record.")]
    numeric = [
        field
        for field in table.fields
        if field.kind in ("float", "int") and field.name not in (*TIME_FIELDS, *without)
    ]
    blocks: list[Block] = []
    for field in numeric[:FIGURES_MAX]:
        title = f"{prefix}{title_of(field)}"
        blocks.extend(grouped_lines(table, source, field.name, title=title, unit=field.unit))
    if len(numeric) > FIGURES_MAX:
        rest = ", ".join(field.name for field in numeric[FIGURES_MAX:])
        blocks.append(Remark(text=f"Not drawn, but in tables/{table.name}.parquet: {rest}."))
    if not numeric and not without:
        blocks.append(Remark(text=f"The stream {table.name} has no numbers to draw."))
    return blocks
