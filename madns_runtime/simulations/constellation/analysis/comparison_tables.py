"""
The comparison of two runs of a constellation: truth, slots, measurements, control, estimates.

For a person as tables, and as plain values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from madns_runtime.analysis.distribution import Summary
from madns_runtime.analysis.sampling import evenly
from madns_runtime.analysis.values import Block, Heading, ReportRemark, TableBlock, headings
from madns_runtime.simulations.constellation.analysis import loop_latency
from madns_runtime.simulations.constellation.analysis.attitudes import (
    AttitudeDifference,
    total_attitude,
)
from madns_runtime.simulations.constellation.analysis.comparison import (
    AXES,
    ConstellationDifference,
    PositionDifference,
    total_effort,
    total_slot_error,
)

AGENTS_SHOWN_MAX = 12
TIMES_SHOWN_MAX = 12
SLOT_COLUMNS = {
    "rms": "slot_error_deg_rms",
    "max": "slot_error_deg_max",
    "rms believed": "slot_error_estimated_deg_rms",
    "delta-v mean": "delta_v_m_s_mean",
    "messages": "messages",
}
ATTITUDE_HEADINGS = (
    "records",
    "rms",
    "max",
    "at t, s",
    "at the end",
    "rates rms",
    "max",
    "end A",
    "end B",
)
ERROR_COLUMNS = {"measurements": "count", "rms": "rms", "max": "max"}
SCORE_COLUMNS = {"predicted": "predicted", "measured": "measured", "score": "score"}
LOOP_COLUMNS = {"count": "count", "p50": "p50", "p99": "p99", "max": "max"}
EFFORT_COLUMNS = {"commands": "commands", "commanded": "commanded_m_s", "given": "given_m_s"}
ESTIMATE_COLUMNS = {"rms": "rms_deg", "settled rms": "settled_rms_deg", "last": "last_deg"}
SCORE_TOLD = ("measurements", "predicted", "measured", "score", "share_within")
LOOP_TOLD = ("count", "p50", "p99", "max")
POSITION_TOLD = ("count", "rms_m", "max_m", "max_t_s", "last_m")
EFFORT_TOLD = ("commanded_m_s", "given_m_s", "commands")
SLOT_ERROR_TOLD = ("rms_deg", "settled_rms_deg", "last_deg", "count")


def comparison_blocks(found: ConstellationDifference) -> list[Block]:
    """Return differences of truth, control and estimates."""
    blocks: list[Block] = [ReportRemark(text=text) for text in found.remarks]
    total = found.all_positions()
    if total is not None:
        blocks += _positions(found, total)
    if any(one.angle_max_rad > 0.0 for one in found.attitudes.values()):
        blocks.append(_attitudes(found.attitudes))
    if any(found.slots):
        blocks.append(_slots(found))
    if any(found.measurements):
        blocks.append(_measurements(found))
    if any(found.scores):
        blocks.append(_predictions(found))
    if any(found.loops):
        blocks.append(_loops(found))
    if any(total_effort(efforts).commands for efforts in found.efforts):
        blocks.append(_efforts(found))
    if any(found.slot_errors):
        title = "Estimates: slot error as flight software believed it, deg"
        blocks.append(_by_agent(title, found.slot_errors, ESTIMATE_COLUMNS, total_slot_error))
    return blocks


def _positions(found: ConstellationDifference, total: PositionDifference) -> Iterator[TableBlock]:
    frame = f" ({found.frame[0]})" if found.frame[0] else ""
    axes = (f"{axis} rms" for axis in AXES)
    # Of satellites that were in the same places there is nothing to tell one by one.
    apart = [one for one in found.positions.values() if one.max_m > 0.0]
    worst = sorted(apart, key=lambda one: one.rms_m, reverse=True)[:AGENTS_SHOWN_MAX]
    shown = [one for one in apart if any(one is other for other in worst)]
    yield TableBlock(
        title=f"Truth: distance between A and B{frame}, m",
        headings=headings("agent", "records", "rms", "max", "at t, s", "at the end", *axes),
        rows=[*(_position(one, one.agent) for one in shown), _position(total, "all")],
        note=_rest(len(apart) - len(shown)),
    )
    if found.over_time:
        names = ("until t, s", "rms, m", "max")
        yield TableBlock(
            title="", headings=[Heading(text=name) for name in names], rows=found.over_time
        )


def _position(one: PositionDifference, name: str) -> list[object]:
    return [name, *(getattr(one, attribute) for attribute in POSITION_TOLD), *one.axes_m()]


def _attitudes(found: Mapping[str, AttitudeDifference]) -> TableBlock:
    apart = [one for one in found.values() if one.angle_max_rad > 0.0]
    shown = sorted(apart, key=lambda one: one.angle_deg_rms, reverse=True)[:AGENTS_SHOWN_MAX]
    return TableBlock(
        title="Truth: angle between the bodies of A and B, deg; body rates, deg/s",
        headings=headings("agent", *ATTITUDE_HEADINGS),
        rows=[
            *([one.agent, *one.told().values()] for one in shown),
            ["all", *total_attitude(found).told().values()],
        ],
        note=_rest(len(apart) - len(shown)),
    )


def _slots(found: ConstellationDifference) -> TableBlock:
    a, b = ({row.t_s: row for row in rows} for rows in found.slots)
    times_s = sorted({*a, *b})
    return TableBlock(
        title="Slots over time: error by truth, deg; delta-v given, m/s; messages sent",
        headings=[Heading(text="t, s"), *_paired(SLOT_COLUMNS)],
        rows=[
            [f"{t_s:g}", *_pairs((a.get(t_s), b.get(t_s)), SLOT_COLUMNS)]
            for t_s in (times_s[place] for place in evenly(len(times_s), TIMES_SHOWN_MAX))
        ],
    )


def _measurements(found: ConstellationDifference) -> TableBlock:
    a, b = found.measurements
    texts = [Heading(text=text, is_number=False) for text in ("sensor", "quantity", "unit")]
    return TableBlock(
        title="Measurements: error against each run's own truth",
        headings=[*texts[:2], *_paired(ERROR_COLUMNS), texts[2]],
        rows=[
            [*key, *_pairs((a.get(key), b.get(key)), ERROR_COLUMNS), (a.get(key) or b[key]).unit]
            for key in dict.fromkeys((*a, *b))
        ],
    )


def _predictions(found: ConstellationDifference) -> TableBlock:
    a, b = found.scores
    keys = list(dict.fromkeys((*a, *b)))
    texts = ("sensor", "quantity", "unit", "agent")
    return TableBlock(
        title="Prediction against measurement: errors of a sensor's model, and of its device, rms",
        headings=[
            *(Heading(text=text, is_number=False) for text in texts),
            *_paired(SCORE_COLUMNS),
        ],
        rows=[[*key, *_pairs((a.get(key), b.get(key)), SCORE_COLUMNS)] for key in keys],
        note="Against each run's own truth; score: measured over predicted.",
    )


def _loops(found: ConstellationDifference) -> TableBlock:
    a, b = ({name: _in_ms(one) for name, one in parts.items()} for parts in found.loops)
    return TableBlock(
        title=loop_latency.TITLE,
        headings=[Heading(text="part", is_number=False), *_paired(LOOP_COLUMNS)],
        rows=[
            [name, *_pairs((a.get(name), b.get(name)), LOOP_COLUMNS)]
            for name in loop_latency.PARTS
            if name in a or name in b
        ],
        note=f"{loop_latency.NOTE} Of all agents.",
    )


def _in_ms(one: Summary) -> Summary:
    times = {name: getattr(one, name) / 1e3 for name in ("p50", "p99", "max")}
    return dataclasses.replace(one, **times)


def _efforts(found: ConstellationDifference) -> TableBlock:
    title = "Control: delta-v, m/s"
    table = _by_agent(title, found.efforts, EFFORT_COLUMNS, total_effort)
    rows = []
    for row in table.rows:
        given = [value for value in row[-2:] if isinstance(value, float)]
        rows.append([*row, given[1] - given[0] if len(given) == 2 else None])
    return TableBlock(
        title=title,
        headings=[*table.headings, Heading(text="given B - A")],
        rows=rows,
        note=table.note,
    )


def _by_agent(
    title: str,
    pair: tuple[Mapping[str, Any], Mapping[str, Any]],
    columns: Mapping[str, str],
    total: Callable[[Any], Any],
) -> TableBlock:
    """Return attributes of what both runs have of each agent side by side, and of all."""
    a, b = pair
    agents = list(dict.fromkeys((*a, *b)))
    rows = [[n, *_pairs((a.get(n), b.get(n)), columns)] for n in agents[:AGENTS_SHOWN_MAX]]
    return TableBlock(
        title=title,
        headings=[Heading(text="agent", is_number=False), *_paired(columns)],
        rows=[*rows, ["all", *_pairs((total(a), total(b)), columns)]],
        note=_rest(len(agents) - AGENTS_SHOWN_MAX),
    )


def _paired(columns: Mapping[str, str]) -> list[Heading]:
    return [Heading(text=f"{name} {run}") for name in columns for run in "AB"]


def _pairs(pair: Sequence[Any], columns: Mapping[str, str]) -> list[Any]:
    return [getattr(one, attribute, None) for attribute in columns.values() for one in pair]


def _rest(count: int) -> str:
    if count <= 0:
        return ""
    return f"and {count} agent{'' if count == 1 else 's'} more; --json has them all"


def to_document(found: ConstellationDifference) -> dict[str, Any]:
    """Return a comparison as plain mappings, lists and scalars: what `cosmos diff --json` tells of it."""
    total = found.all_positions()
    truth = None
    if total is not None:
        truth = {
            "all": _position_told(total),
            "agents": {name: _position_told(one) for name, one in found.positions.items()},
            "over_time": [_stretch(row, "m") for row in found.over_time],
        }
    return {
        "frame": list(found.frame),
        "truth": truth,
        "attitude": {name: one.told() for name, one in found.attitudes.items()},
        "slots": [[dataclasses.asdict(row) for row in rows] for rows in found.slots],
        "measurements": _measurements_told(found),
        "predictions": _predictions_told(found),
        "loop_us": {
            part: [_told(parts.get(part), LOOP_TOLD) for parts in found.loops]
            for part in loop_latency.PARTS
            if any(part in parts for parts in found.loops)
        },
        "control": _both_told(found.efforts, EFFORT_TOLD, total_effort),
        "estimates": _both_told(found.slot_errors, SLOT_ERROR_TOLD, total_slot_error)
        | {"over_time": [[_stretch(r, "deg") for r in rows] for rows in found.slot_over_time]},
        "remarks": found.remarks,
    }


def _told(one: Any, attributes: Iterable[str]) -> dict[str, Any] | None:
    return None if one is None else {name: getattr(one, name) for name in attributes}


def _both_told(
    pair: tuple[Mapping[str, Any], Mapping[str, Any]],
    attributes: Iterable[str],
    total: Callable[[Any], Any],
) -> dict[str, Any]:
    agents = dict.fromkeys((*pair[0], *pair[1]))
    return {
        "all": [_told(total(one), attributes) for one in pair],
        "agents": {name: [_told(one.get(name), attributes) for one in pair] for name in agents},
    }


def _position_told(found: PositionDifference) -> dict[str, Any]:
    axes = zip(AXES, found.axes_m(), strict=True)
    numbers = {name: getattr(found, name) for name in POSITION_TOLD}
    return numbers | {f"{axis}_rms_m": value for axis, value in axes}


def _measurements_told(found: ConstellationDifference) -> list[dict[str, Any]]:
    a, b = found.measurements
    return [
        {
            "sensor": key[0],
            "quantity": key[1],
            "unit": (a.get(key) or b[key]).unit,
            "errors": [_told(one.get(key), ("count", "rms", "max")) for one in (a, b)],
        }
        for key in dict.fromkeys((*a, *b))
    ]


def _predictions_told(found: ConstellationDifference) -> list[dict[str, Any]]:
    a, b = found.scores
    return [
        dict(zip(("sensor", "quantity", "unit", "agent"), key, strict=True))
        | {"scores": [_told(one.get(key), SCORE_TOLD) for one in (a, b)]}
        for key in dict.fromkeys((*a, *b))
    ]


def _stretch(row: Sequence[float], unit: str) -> dict[str, float]:
    return {"t_s": row[0], f"rms_{unit}": row[1], f"max_{unit}": row[2]}
