"""Tables and sentences of a comparison, for terminal and page alike."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from cosmos_cli.diff.compare import Comparison, KeyDifference
from cosmos_cli.diff.fields import RecordPlace
from cosmos_cli.diff.stream import Alone, By, StreamDifference
from cosmos_cli.ui.name_ranges import names_by
from cosmos_cli.ui.plural import counted
from madns_runtime.analysis.values import Heading, ReportRemark, TableBlock
from madns_runtime.plain_values import first_few

KEYS_SHOWN_MAX = 40
AGENTS_SHOWN_MAX = 12
TEXT_CHARACTERS_MAX = 44


def _headings(*words: str, numbers: Sequence[str] = ()) -> tuple[Heading, ...]:
    return tuple(Heading(text=word, is_number=word in numbers) for word in words)


STREAM_HEADINGS = _headings(
    *("stream", "matched by", "A", "B", "matched", "only A", "only B", ""),
    numbers=("A", "B", "matched", "only A", "only B"),
)
FIELD_HEADINGS = _headings(
    *("stream", "field", "records", "rms", "max", "unit", "largest at", "first at"),
    numbers=("records", "rms", "max"),
)
KEY_WORDS: Mapping[By, str] = {"tick": "tick ", "time": "t = ", "order": "record "}


def blocks_of(found: Comparison) -> Iterator[TableBlock | ReportRemark]:
    """Yield what differs between two runs but for what their simulation tells, each as a table or a sentence; none for nothing."""
    for title, keys in (("Settings", found.settings), ("Versions", found.versions)):
        if keys:
            yield _keys_table(f"{title} that differ", keys)
    timing = [
        [one.title, one.a, one.b] for one in found.timing if not (one.a is None and one.b is None)
    ]
    if timing:
        headings = _headings("", "A", "B", numbers=("A", "B"))
        yield TableBlock(title="Timing", headings=headings, rows=timing)
    if found.summaries:
        figures = counted(len(found.summaries), "figure")
        yield ReportRemark(text=f"{figures} of the simulation's summaries differ; --json has them")
    totals = found.totals()
    if totals:
        rows = [_stream_row(one) for one in totals]
        yield TableBlock(title="Records", headings=STREAM_HEADINGS, rows=rows)
    if fields := [row for total in totals for row in _field_rows(found, total)]:
        yield TableBlock(title="Fields that differ", headings=FIELD_HEADINGS, rows=fields)
    for line in (*_text_lines(found, totals), *_alone_lines(totals)):
        yield ReportRemark(text=line)
    for name, streams in (("A", found.only_a), ("B", found.only_b)):
        for table, sources in names_by(streams).items():
            yield ReportRemark(
                text=f"only in {name}: {table} of {first_few(sources, AGENTS_SHOWN_MAX)}"
            )


def _keys_table(title: str, keys: Sequence[KeyDifference]) -> TableBlock:
    more = len(keys) - KEYS_SHOWN_MAX
    return TableBlock(
        title=title,
        headings=_headings("key", "A", "B"),
        rows=[[one.key, _short(one.a), _short(one.b)] for one in keys[:KEYS_SHOWN_MAX]],
        note=f"and {more} more; --json has them all" if more > 0 else "",
    )


def _stream_row(one: StreamDifference) -> list[object]:
    alike = "same values" if one.has_same_values else "different"
    word = "identical" if one.is_identical else alike
    counts = (one.rows_a, one.rows_b, one.matched, one.only_a.count, one.only_b.count)
    return [one.table, one.by, *counts, word]


def _field_rows(found: Comparison, total: StreamDifference) -> list[list[object]]:
    return [
        [
            total.table,
            name,
            one.different,
            one.rms if one.is_number else None,
            one.max if one.is_number else None,
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
                lines.append(
                    f"{total.table}: {first_few(fields, AGENTS_SHOWN_MAX)} only recorded in {name}"
                )
    return lines


def _told_alone(alone: Alone, by: By) -> str:
    assert alone.first is not None and alone.last is not None
    first, last = _words(alone.first, by), _words(alone.last, by)
    if alone.count == 1:
        return f"1 record ({first})"
    return f"{alone.count} records ({first} to {last})"


def _short(value: object) -> str:
    text = "-" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)
    if len(text) <= TEXT_CHARACTERS_MAX:
        return text
    return f"{text[: TEXT_CHARACTERS_MAX - 3]}..."
