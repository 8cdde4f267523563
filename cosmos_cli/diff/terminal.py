"""A comparison for a person: what differs, first in words, then in tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cosmos_cli.diff.compare import Comparison, KeyDifference, Timed
from cosmos_cli.diff.fields import RecordPlace
from cosmos_cli.diff.stream import Alone, By, StreamDifference
from cosmos_cli.report.cells import format_cell
from cosmos_cli.report.terminal import verdict_line
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.name_ranges import names_by
from cosmos_cli.ui.plural import counted
from madns_runtime.analysis.values import ReportRemark, SimulationDifference, TableBlock

KEYS_SHOWN_MAX = 40
AGENTS_SHOWN_MAX = 12
TEXT_CHARACTERS_MAX = 44
STREAM_COLUMNS = (
    Column("stream"),
    Column("matched by"),
    *(Column(name, True) for name in ("A", "B", "matched", "only A", "only B")),
    Column(""),
)
FIELD_COLUMNS = (
    Column("stream"),
    Column("field"),
    *(Column(name, True) for name in ("records", "rms", "max")),
    Column("unit"),
    Column("largest at"),
    Column("first at"),
)
KEY_WORDS: Mapping[By, str] = {"tick": "tick ", "time": "t = ", "order": "record "}


def print_comparison(console: Console, found: Comparison) -> None:
    """Print a comparison on stdout; its last line says whether the runs are the same."""
    names = (found.a.run.name, found.b.run.name)
    console.data(verdict_line(f"A  {names[0]}", found.a.document))
    console.data(verdict_line(f"B  {names[1]}", found.b.document))
    for line in found.missing:
        console.data(f"missing: {line}")
    for line in found.remarks:
        console.data(f"remark: {line}")
    _print_keys(console, "Settings", found.settings)
    _print_keys(console, "Versions", found.versions)
    _print_timing(console, found.timing)
    if found.summaries:
        figures = counted(len(found.summaries), "figure")
        console.data(f"\n{figures} of the simulation's summaries differ; --json has them")
    _print_streams(console, found)
    if found.by_simulation is not None:
        _print_by_simulation(console, found.by_simulation)
    console.data("")
    console.data(verdict_of(found))


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


def _print_by_simulation(console: Console, found: SimulationDifference) -> None:
    for block in found.blocks:
        if isinstance(block, ReportRemark):
            console.data(f"remark: {block.text}")
        elif isinstance(block, TableBlock):
            console.data(f"\n{block.title}" if block.title else "")
            columns = [Column(h.text, is_number=h.is_number) for h in block.headings]
            console.table(columns, [[format_cell(cell) for cell in row] for row in block.rows])
            if block.note:
                console.data(block.note)


def _print_table(
    console: Console, title: str, columns: Sequence[Column], rows: Sequence[Sequence[str]]
) -> None:
    """Print a table under its title; nothing without a row."""
    if rows:
        console.data(f"\n{title}" if title else "")
        console.table(columns, rows)


def _print_keys(console: Console, title: str, keys: Sequence[KeyDifference]) -> None:
    rows = [[one.key, _short(one.a), _short(one.b)] for one in keys[:KEYS_SHOWN_MAX]]
    columns = [Column("key"), Column("A"), Column("B")]
    _print_table(console, f"{title} that differ", columns, rows)
    if len(keys) > KEYS_SHOWN_MAX:
        console.data(f"and {len(keys) - KEYS_SHOWN_MAX} more; --json has them all")


def _print_timing(console: Console, timing: Sequence[Timed]) -> None:
    rows = [
        [one.title, format_cell(one.a), format_cell(one.b)]
        for one in timing
        if one.a is not None or one.b is not None
    ]
    _print_table(console, "Timing", [Column(""), Column("A", True), Column("B", True)], rows)


def _print_streams(console: Console, found: Comparison) -> None:
    totals = found.totals()
    _print_table(console, "Records", STREAM_COLUMNS, [_stream_row(one) for one in totals])
    rows = [row for total in totals for row in _field_rows(found, total)]
    _print_table(console, "Fields that differ", FIELD_COLUMNS, rows)
    for line in (*_text_lines(found, totals), *_alone_lines(totals)):
        console.data(line)
    for name, keys in (("A", found.only_a), ("B", found.only_b)):
        for table, sources in names_by(keys).items():
            console.data(f"only in {name}: {table} of {_listed(sources)}")


def _stream_row(one: StreamDifference) -> list[str]:
    alike = "same values" if one.has_same_values else "different"
    word = "identical" if one.is_identical else alike
    counts = (one.rows_a, one.rows_b, one.matched, one.only_a.count, one.only_b.count)
    return [one.table, one.by, *(format_cell(count) for count in counts), word]


def _field_rows(found: Comparison, total: StreamDifference) -> list[list[str]]:
    return [
        [
            total.table,
            name,
            format_cell(one.different),
            format_cell(one.rms if one.is_number else None),
            format_cell(one.max if one.is_number else None),
            one.field.unit,
            _told_place(one.at, total.by, found),
            _told_place(one.first, total.by, found),
        ]
        for name, one in total.fields.items()
        if one.different
    ]


def _told_place(place: RecordPlace | None, by: By, found: Comparison) -> str:
    if place is None:
        return "-"
    unit = " s" if by == "time" else ""
    hz = found.a.tick_hz
    time = f" ({place.key / hz:.12g} s)" if by == "tick" and hz != 1.0 else ""
    return f"{_words(place, by)}{unit}{time}"


def _words(place: RecordPlace, by: By) -> str:
    return f"{place.who} {KEY_WORDS[by]}{place.key:.12g}".strip()


def _text_lines(found: Comparison, totals: Sequence[StreamDifference]) -> list[str]:
    """Say what the first different texts are: they have no size."""
    return [
        f"{total.table}.{name}, {_told_place(one.at, total.by, found)}:"
        f" {_short(one.values[0])} in A, {_short(one.values[1])} in B"
        for total in totals
        for name, one in total.fields.items()
        if one.values is not None and not one.is_number
    ]


def _alone_lines(totals: Sequence[StreamDifference]) -> list[str]:
    lines = []
    for total in totals:
        for name, alone in (("A", total.only_a), ("B", total.only_b)):
            if alone.count:
                lines.append(f"{total.table}: {_told_alone(alone, total.by)} only in {name}")
        for name, fields in (("A", total.fields_only_a), ("B", total.fields_only_b)):
            if fields:
                lines.append(f"{total.table}: {_listed(fields)} only recorded in {name}")
    return lines


def _told_alone(alone: Alone, by: By) -> str:
    assert alone.first is not None and alone.last is not None
    first, last = _words(alone.first, by), _words(alone.last, by)
    if alone.count == 1:
        return f"1 record ({first})"
    return f"{alone.count} records ({first} to {last})"


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:AGENTS_SHOWN_MAX])
    return (
        shown
        if len(names) <= AGENTS_SHOWN_MAX
        else f"{shown} and {len(names) - AGENTS_SHOWN_MAX} more"
    )


def _short(value: object) -> str:
    text = "-" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)
    if len(text) <= TEXT_CHARACTERS_MAX:
        return text
    return f"{text[: TEXT_CHARACTERS_MAX - 3]}..."
