"""The comparison of two runs of a constellation for a person: truth, slots, measurements, control, estimates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cosmos_cli.console import Column, Console
from cosmos_cli.counted import counted
from cosmos_cli.diff.constellation import AXES, ConstellationDifference, PositionDifference
from cosmos_cli.diff.control import total_effort, total_slot_error
from cosmos_cli.report.model import format_cell
from cosmos_cli.report.sampling import evenly
from cosmos_cli.spread import Stretch

AGENTS_SHOWN_MAX = 12
TIMES_SHOWN_MAX = 12


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
    if any(found.slots):
        _title(console, "Slots over time: error by truth, deg; delta-v given, m/s; messages sent")
        _print_slots(console, found)
    if any(found.measurements):
        _title(console, "Measurements: error against each run's own truth")
        _print_measurements(console, found)
    if any(total_effort(efforts).commands for efforts in found.efforts):
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
    # Of satellites that were in the same places there is nothing to tell one by one.
    apart = [one for one in found.positions.values() if one.max_m > 0.0]
    shown, rest = _worst(apart, lambda one: one.rms_m)
    rows = [_position_row(one, one.agent) for one in shown]
    console.table(columns, [*rows, _position_row(total, "all")])
    _tell_rest(console, rest)


def _position_row(one: PositionDifference, name: str) -> list[str]:
    cells = (one.count, one.rms_m, one.max_m, one.max_t_s, one.last_m, *one.axes_m())
    return [name, *(format_cell(cell) for cell in cells)]


def _print_over_time(console: Console, rows: Sequence[Stretch], unit: str) -> None:
    if not rows:
        return
    columns = [Column("until t, s", True), Column(f"rms, {unit}", True), Column("max", True)]
    console.data("")
    console.table(columns, [[format_cell(cell) for cell in row] for row in rows])


def _print_slots(console: Console, found: ConstellationDifference) -> None:
    columns = [Column("t, s", True)]
    for name in ("rms", "max", "rms believed", "delta-v mean", "messages"):
        columns += [Column(f"{name} A", True), Column(f"{name} B", True)]
    a, b = ({row.t_s: row for row in rows} for rows in found.slots)
    times_s = sorted({*a, *b})
    names = (
        "slot_error_deg_rms",
        "slot_error_deg_max",
        "slot_error_estimated_deg_rms",
        "delta_v_m_s_mean",
        "messages",
    )
    rows = [
        [f"{t_s:g}"]
        + [format_cell(getattr(one.get(t_s), name, None)) for name in names for one in (a, b)]
        for t_s in (times_s[place] for place in evenly(len(times_s), TIMES_SHOWN_MAX))
    ]
    console.table(columns, rows)


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


def _title(console: Console, text: str) -> None:
    console.data(f"\n{text}")
