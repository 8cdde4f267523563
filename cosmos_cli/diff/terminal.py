"""A comparison for a person: what differs, first in words, then in tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cosmos_cli.console import Column, Console
from cosmos_cli.counted import counted
from cosmos_cli.diff.compare import Comparison, Timed
from cosmos_cli.diff.constellation import AXES, ConstellationDifference, PositionDifference
from cosmos_cli.diff.control import total_effort, total_slot_error
from cosmos_cli.diff.fields import FieldDifference, Place
from cosmos_cli.diff.settings import KeyDifference
from cosmos_cli.diff.stream import Alone, By, StreamDifference
from cosmos_cli.report.model import format_cell
from cosmos_cli.spread import Stretch

KEYS_SHOWN_MAX = 40
AGENTS_SHOWN_MAX = 12
STRETCHES_SHOWN_MAX = 12
TEXT_CHARACTERS_MAX = 44
KEY_WORDS: Mapping[By, str] = {"tick": "tick ", "time": "t = ", "order": "record "}


def print_comparison(console: Console, found: Comparison) -> None:
    """Print a comparison on stdout; its last line says whether the runs are the same."""
    names = (found.a.run.name, found.b.run.name)
    console.data(f"A  {names[0]}: {found.a.document.get('verdict')}")
    console.data(f"B  {names[1]}: {found.b.document.get('verdict')}")
    for line in found.missing:
        console.data(f"missing: {line}")
    for line in found.remarks:
        console.data(f"remark: {line}")
    _print_keys(console, "Settings", found.settings)
    _print_keys(console, "Versions", found.versions)
    _print_timing(console, found.timing)
    _print_streams(console, found)
    if found.constellation is not None:
        print_constellation(console, found.constellation)
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


def print_constellation(console: Console, found: ConstellationDifference) -> None:
    """Print differences of truth, control and estimates."""
    frame = f" ({found.frame[0]})" if found.frame[0] else ""
    for line in found.remarks:
        console.data(f"remark: {line}")
    total = found.all_positions()
    if total is not None:
        _title(console, f"Truth: distance between A and B{frame}, m")
        _print_positions(console, found, total)
        _print_over_time(console, found.over_time, "m")
    if any(found.measurements):
        _title(console, "Measurements: error against each run's own truth")
        _print_measurements(console, found)
    if any(found.efforts):
        _title(console, "Control: delta-v, m/s")
        _print_efforts(console, found)
    if any(found.slot_errors):
        _title(console, "Estimates: slot error as flight software believed it, deg")
        _print_slot_errors(console, found)


def _print_positions(
    console: Console, found: ConstellationDifference, total: PositionDifference
) -> None:
    columns = [Column("agent")]
    columns += [
        Column(n, is_number=True) for n in ("records", "rms", "max", "at t, s", "at the end")
    ]
    columns += [Column(f"{axis} rms", is_number=True) for axis in AXES]
    shown, rest = _worst(list(found.positions.values()), lambda one: one.rms_m)
    rows = [_position_row(one, one.agent) for one in shown]
    console.table(columns, [*rows, _position_row(total, "all")])
    _tell_rest(console, rest)


def _position_row(one: PositionDifference, name: str) -> list[str]:
    cells = (one.count, one.rms_m, one.max_m, one.max_t_s, one.last_m, *one.axes_m())
    return [name, *(format_cell(cell) for cell in cells)]


def _print_over_time(console: Console, rows: Sequence[Stretch], unit: str) -> None:
    if not rows:
        return
    step = -(-len(rows) // STRETCHES_SHOWN_MAX)
    columns = [Column("until t, s", True), Column(f"rms, {unit}", True), Column("max", True)]
    console.data("")
    console.table(columns, [[format_cell(cell) for cell in row] for row in rows[step - 1 :: step]])


def _print_measurements(console: Console, found: ConstellationDifference) -> None:
    columns = [Column("sensor"), Column("quantity")]
    for name in ("measurements", "rms", "max"):
        columns += [Column(f"{name} A", True), Column(f"{name} B", True)]
    columns.append(Column("unit"))
    a, b = found.measurements
    rows = []
    for key in dict.fromkeys((*a, *b)):
        pair = (a.get(key), b.get(key))
        names = ("count", "rms", "max")
        cells = [format_cell(getattr(one, name, None)) for name in names for one in pair]
        rows.append([*key, *cells, (pair[0] or b[key]).unit])
    console.table(columns, rows)


def _print_efforts(console: Console, found: ConstellationDifference) -> None:
    columns = [Column("agent")]
    for name in ("commands", "commanded", "given"):
        columns += [Column(f"{name} A", True), Column(f"{name} B", True)]
    columns.append(Column("given B - A", True))
    a, b = found.efforts
    agents = list(dict.fromkeys((*a, *b)))
    shown, rest = agents[:AGENTS_SHOWN_MAX], len(agents) - AGENTS_SHOWN_MAX
    rows = [_effort_row(name, a.get(name), b.get(name)) for name in shown]
    console.table(columns, [*rows, _effort_row("all", total_effort(a), total_effort(b))])
    _tell_rest(console, max(rest, 0))


def _effort_row(name: str, a: Any, b: Any) -> list[str]:
    cells: list[object] = []
    for attribute in ("commands", "commanded_m_s", "given_m_s"):
        cells += [getattr(a, attribute, None), getattr(b, attribute, None)]
    given = cells[-2:]
    more = given[1] - given[0] if all(isinstance(v, float) for v in given) else None  # type: ignore[operator]
    return [name, *(format_cell(cell) for cell in (*cells, more))]


def _print_slot_errors(console: Console, found: ConstellationDifference) -> None:
    columns = [Column("agent")]
    for name in ("rms", "settled rms", "last"):
        columns += [Column(f"{name} A", True), Column(f"{name} B", True)]
    a, b = found.slot_errors
    agents = list(dict.fromkeys((*a, *b)))
    rows = [_slot_row(name, a.get(name), b.get(name)) for name in agents[:AGENTS_SHOWN_MAX]]
    console.table(columns, [*rows, _slot_row("all", total_slot_error(a), total_slot_error(b))])
    _tell_rest(console, max(len(agents) - AGENTS_SHOWN_MAX, 0))


def _slot_row(name: str, a: Any, b: Any) -> list[str]:
    cells: list[object] = []
    for attribute in ("rms_deg", "settled_rms_deg", "last_deg"):
        cells += [getattr(a, attribute, None), getattr(b, attribute, None)]
    return [name, *(format_cell(cell) for cell in cells)]


def _print_keys(console: Console, title: str, keys: Sequence[KeyDifference]) -> None:
    if not keys:
        return
    _title(console, f"{title} that differ")
    columns = [Column("key"), Column("A"), Column("B")]
    rows = [[one.key, _short(one.a), _short(one.b)] for one in keys[:KEYS_SHOWN_MAX]]
    console.table(columns, rows)
    if len(keys) > KEYS_SHOWN_MAX:
        console.data(f"and {len(keys) - KEYS_SHOWN_MAX} more; --json has them all")


def _print_timing(console: Console, timing: Sequence[Timed]) -> None:
    rows = [
        [one.title, format_cell(one.a), format_cell(one.b)]
        for one in timing
        if one.a is not None or one.b is not None
    ]
    if rows:
        _title(console, "Timing")
        console.table([Column(""), Column("A", True), Column("B", True)], rows)


def _print_streams(console: Console, found: Comparison) -> None:
    totals = found.totals()
    if totals:
        _title(console, "Records")
        columns = [Column("stream"), Column("matched by")]
        columns += [Column(n, True) for n in ("A", "B", "matched", "only A", "only B")]
        columns.append(Column(""))
        console.table(columns, [_stream_row(one) for one in totals])
    rows = [row for total in totals for row in _field_rows(found, total)]
    if rows:
        _title(console, "Fields that differ")
        columns = [Column("stream"), Column("field")]
        columns += [Column(n, True) for n in ("records", "rms", "max")]
        columns += [Column("unit"), Column("largest at"), Column("first at"), Column("A | B there")]
        console.table(columns, rows)
    for line in _alone_lines(totals):
        console.data(line)
    for name, keys in (("A", found.only_a), ("B", found.only_b)):
        for table, sources in _by_table(keys).items():
            console.data(f"only in {name}: {table} of {_listed(sources)}")


def _stream_row(one: StreamDifference) -> list[str]:
    word = "different"
    if one.is_identical:
        word = "identical"
    elif one.has_same_values:
        word = "same values"
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
            _told_values(one),
        ]
        for name, one in total.fields.items()
        if one.different
    ]


def _told_place(place: Place | None, by: By, found: Comparison) -> str:
    if place is None:
        return "-"
    word = KEY_WORDS[by]
    unit = " s" if by == "time" else ""
    time = f" ({place.key / found.a.tick_hz:g} s)" if by == "tick" else ""
    return f"{place.who} {word}{place.key:g}{unit}{time}".strip()


def _told_values(one: FieldDifference) -> str:
    if one.values is None:
        return ""
    return " | ".join(_short(value) for value in one.values)


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
    assert alone.first is not None
    assert alone.last is not None
    word = KEY_WORDS[by]
    first = f"{alone.first.who} {word}{alone.first.key:g}".strip()
    if alone.count == 1:
        return f"1 record ({first})"
    last = f"{alone.last.who} {word}{alone.last.key:g}".strip()
    return f"{alone.count} records ({first} to {last})"


def _by_table(keys: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    tables: dict[str, list[str]] = {}
    for table, source in keys:
        tables.setdefault(table, []).append(source)
    return tables


def _worst(items: list[Any], size: Any) -> tuple[list[Any], int]:
    """Return what is shown, those with the largest differences in their own order, and how many are not."""
    if len(items) <= AGENTS_SHOWN_MAX:
        return items, 0
    chosen = sorted(items, key=size, reverse=True)[:AGENTS_SHOWN_MAX]
    names = {id(item) for item in chosen}
    return [item for item in items if id(item) in names], len(items) - AGENTS_SHOWN_MAX


def _tell_rest(console: Console, rest: int) -> None:
    if rest:
        console.data(f"and {counted(rest, 'agent')} more; --json has them all")


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:AGENTS_SHOWN_MAX])
    return (
        shown
        if len(names) <= AGENTS_SHOWN_MAX
        else f"{shown} and {len(names) - AGENTS_SHOWN_MAX} more"
    )


def _title(console: Console, text: str) -> None:
    console.data(f"\n{text}")


def _short(value: object) -> str:
    text = "-" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)
    if len(text) <= TEXT_CHARACTERS_MAX:
        return text
    return f"{text[: TEXT_CHARACTERS_MAX - 3]}..."
