"""The report's content: from a run's tables and summary to sections."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import Any

from cosmos_cli.expectation import mapping_at
from cosmos_cli.report.control import as_document, read_control
from cosmos_cli.report.figures import FIGURES, TEXT_STREAMS, Chapter, chapter_of
from cosmos_cli.report.figures.slots import slot_blocks
from cosmos_cli.report.model import Block, Heading, Remark, Section, TableBlock
from cosmos_cli.report.source import Source
from cosmos_cli.rundir import RunDirectory
from cosmos_cli.statistics import tick_statistics
from cosmos_cli.tables import TableReader, open_tables

SENTENCES_MAX = 60
CONTROL = "Control"
LEVELS_TOLD = ("critical", "error", "warning")
NOT_MEASURED = "not measured"
OF_MACHINES = ("machine_health", "host_health", "process", "clock")


def open_source(run: RunDirectory, document: Mapping[str, Any]) -> Source:
    """Open what a run's report is made from."""
    config = run.read_config()
    tables = open_tables(run.tables)
    return Source(
        document=document,
        tables=tables,
        tick_hz=config.agents.tick_hz if config else None,
        ticks=tick_statistics(tables.get("ticks")),
        control=read_control(tables, config),
        unread=_unread(run, tables),
    )


def _unread(run: RunDirectory, tables: Mapping[str, TableReader]) -> tuple[str, ...]:
    listed = mapping_at(run.read_json(run.manifest_json) or {}, "files")
    paths = [PurePosixPath(name) for name in listed]
    folder = run.tables.name
    return tuple(str(path) for path in paths if path.parts[0] == folder and path.stem not in tables)


def with_control(run: RunDirectory, document: Mapping[str, Any]) -> dict[str, Any]:
    """Return run.json, for a constellation under control with its slots over time."""
    config = run.read_config()
    control = as_document(read_control(open_tables(run.tables), config), config)
    return {**document, **({} if control is None else {"control": control})}


def build_sections(source: Source) -> list[Section]:
    """Return the report's sections: known streams in the order of `FIGURES`, then others, then words."""
    sections: dict[str, list[Block]] = {}
    slots = slot_blocks(source.control)
    for table, chapter in _chapters(source.tables):
        # What flight software believes, and what it commanded, comes after what became of its slots.
        first = slots if chapter.title == CONTROL else []
        sections.setdefault(chapter.title, [*first]).extend(_build(table, chapter, source))
    built = [Section(title=title, blocks=blocks) for title, blocks in sections.items() if blocks]
    return [*_gaps(source), *built, *_words(source)]


def _gaps(source: Source) -> list[Section]:
    if not source.unread:
        return []
    text = (
        f"{', '.join(source.unread)} cannot be read: what they hold is not shown;"
        f" cosmos collect {source.document.get('run')} makes them anew."
    )
    return [Section(title="Tables that are missing", blocks=[Remark(text=text)])]


def _chapters(tables: Mapping[str, TableReader]) -> Iterator[tuple[TableReader, Chapter]]:
    order = [name for name in FIGURES if name in tables]
    order += [name for name in tables if name not in FIGURES and name not in TEXT_STREAMS]
    # What the simulation recorded comes before what the framework knows of machines and clocks.
    for name in sorted(order, key=lambda name: name in OF_MACHINES):
        yield tables[name], chapter_of(tables[name])


def _build(table: TableReader, chapter: Chapter, source: Source) -> list[Block]:
    try:
        return chapter.build(table, source)
    except Exception as error:  # noqa: BLE001 - a figure of anybody's stream must not cost a run its report
        text = f"The figures of {table.name} could not be drawn: {type(error).__name__}: {error}"
        return [Remark(text=text)]


def _words(source: Source) -> list[Section]:
    rows = [row for name in ("host_log", "log") for row in _sentences(source, name)]
    rows.sort(key=lambda row: str(row[0]))
    if not rows:
        return []
    note = f"The first {SENTENCES_MAX} of {len(rows)}." if len(rows) > SENTENCES_MAX else ""
    headings = [
        Heading(text=text, is_number=False) for text in ("UTC", "who", "level", "what was said")
    ]
    table = TableBlock(
        title="Warnings and errors", headings=headings, rows=rows[:SENTENCES_MAX], note=note
    )
    return [Section(title="What was said", blocks=[table])]


def _sentences(source: Source, name: str) -> Iterator[list[object]]:
    table = source.tables.get(name)
    if table is None or not table.has("utc", "level", "text"):
        return
    for who, columns in table.each(("utc", "level", "text")):
        for utc, level, text in zip(*columns.values(), strict=True):
            if level in LEVELS_TOLD:
                yield [utc, who, level, text]


def figures_of(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return the handful of numbers that tell most of a run: name, value, remark."""
    timing, round_trip = mapping_at(document, "timing"), mapping_at(document, "round_trip_ms")
    lateness = mapping_at(timing, "lateness_ms")
    records, agents = mapping_at(document, "records"), mapping_at(document, "agents")
    reliable = mapping_at(document, "messages", "reliable")
    sync = mapping_at(document, "messages", "sync")
    best = mapping_at(document, "messages", "best")
    lost = agents.get("lost") or ()
    return [
        ("agents", _number(agents.get("count")), f"{len(lost)} lost"),
        ("real-time factor", _number(document.get("rtf"), ".7g"), "simulated per wall second"),
        (
            "ticks missed",
            _number(timing.get("missed")),
            f"of {_number(timing.get('ticks'))}",
        ),
        (
            "lateness p99",
            _milliseconds(lateness.get("p99")),
            f"max {_milliseconds(lateness.get('max'))}" if lateness else NOT_MEASURED,
        ),
        (
            "round trip p50",
            _milliseconds(round_trip.get("p50")),
            _round_trip_remark(round_trip) if "p50" in round_trip else NOT_MEASURED,
        ),
        (
            "messages lost",
            f"{_number(reliable.get('lost'))} + {_number(sync.get('lost'))}",
            f"reliable + sync; telemetry {_number(best.get('lost'))}",
        ),
        (
            "records",
            _number(records.get("written")),
            f"{_number(records.get('dropped'))} dropped, {_number(records.get('truncated'))} streams cut,"
            f" {_number(records.get('not_finite'))} values not finite",
        ),
    ]


def _round_trip_remark(round_trip: Mapping[str, Any]) -> str:
    """Tell the tail; of the clock's exchanges, of which only the quickest are recorded, there is none."""
    name = "p99" if "p99" in round_trip else "max"
    return f"{name} {_milliseconds(round_trip.get(name))} ({round_trip.get('stream', 'none')})"


def _milliseconds(value: object) -> str:
    return "–" if value is None else f"{_number(value, '.3g')} ms"


def _number(value: object, form: str = "") -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "–"
    if form:
        return format(value, form)
    return f"{value:,}".replace(",", "\u202f")
