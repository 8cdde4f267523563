"""From a table of chapters to sections: which figures a stream gets is data."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from madns_runtime.analysis.tables import RecordedRun, RecordedTable, Tables
from madns_runtime.analysis.values import Block, ReportRemark, Section
from madns_runtime.recording.records import Field


@dataclass(frozen=True, slots=True)
class Chapter:
    """A section's title and what fills it. Streams of one title share a section."""

    title: str
    build: Callable[[RecordedTable, RecordedRun], Sequence[Block]]
    fields: tuple[Field, ...] = ()
    """Fields that the stream must hold, by name and unit."""

    def fits(self, table: RecordedTable) -> bool:
        """Tell whether a table is what these figures mean."""
        units = {field.name: field.unit for field in table.fields}
        return all(units.get(field.name) == field.unit for field in self.fields)


def build_sections(chapters: Mapping[str, Chapter], run: RecordedRun) -> list[Section]:
    """
    Return the sections of all tables that have a chapter, in the chapters' order.

    A chapter that raises costs its own figures and leaves a remark.

    Args:
        chapters: By table name.
        run: Whose tables are drawn; one that does not fit its chapter is left to others.
    """
    blocks: dict[str, list[Block]] = {}
    tables: dict[str, list[str]] = {}
    for table, chapter in _fitting(chapters, run.tables):
        blocks.setdefault(chapter.title, []).extend(_build(table, chapter, run))
        tables.setdefault(chapter.title, []).append(table.name)
    return [
        Section(title=title, blocks=found, tables=tables[title]) for title, found in blocks.items()
    ]


def _fitting(
    chapters: Mapping[str, Chapter], tables: Tables
) -> Iterator[tuple[RecordedTable, Chapter]]:
    for name, chapter in chapters.items():
        table = tables.get(name)
        if table is not None and chapter.fits(table):
            yield table, chapter


def _build(table: RecordedTable, chapter: Chapter, run: RecordedRun) -> Sequence[Block]:
    try:
        return list(chapter.build(table, run))  # which does its work here, if it yields them
    except Exception as error:  # noqa: BLE001 - a figure of anybody's stream must not cost a run its report
        text = f"The figures of {table.name} could not be drawn: {type(error).__name__}: {error}"
        return [ReportRemark(text=text)]
