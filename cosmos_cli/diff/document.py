"""
A comparison as JSON: what `cosmos diff --json` prints, schema 1. Pure.

    schema, runs {a, b}, same, identical
    settings, versions, summaries    lists of {key, a, b}; null where a run does not have the key
    timing                           {key of run.json: [a, b]}
    streams                          one a stream: {table, by, rows [a, b], matched, identical, only_a, only_b, fields,
                                     fields_only_a, fields_only_b, sources}; sources hold the same of each agent or machine
        only_a, only_b               {count, first {key, who}, last {key, who}}
        fields                       {name: {unit, different, compared, null_in_one, rms, max, at {key, who}, first, values}}
    streams_only_a, streams_only_b   lists of [table, source]
    constellation                    null, or {frame, truth, slots, measurements, control, estimates, remarks}
    missing, remarks                 lists of sentences

A key is a tick where `by` is tick, a time in s where it is time, and the number of the record where it is order.
Differences are those of the second run from the first; a number that is not finite is null.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cosmos_cli.diff.compare import Comparison
from cosmos_cli.diff.constellation import AXES, ConstellationDifference, PositionDifference
from cosmos_cli.diff.control import Effort, SlotError, total_effort, total_slot_error
from cosmos_cli.diff.fields import FieldDifference, Place
from cosmos_cli.diff.measurements import MeasurementError
from cosmos_cli.diff.stream import Alone, StreamDifference

SCHEMA = 1


def to_document(found: Comparison) -> dict[str, Any]:
    """Return the comparison as plain mappings, lists and scalars."""
    constellation = found.constellation
    document = {
        "schema": SCHEMA,
        "runs": {"a": found.a.run.name, "b": found.b.run.name},
        "simulation": found.a.simulation,
        "same": found.is_same,
        "identical": found.is_identical,
        "settings": [one.to_mapping() for one in found.settings],
        "versions": [one.to_mapping() for one in found.versions],
        "summaries": [one.to_mapping() for one in found.summaries],
        "timing": {one.key: [one.a, one.b] for one in found.timing},
        "streams": [
            {
                **_stream(total),
                "sources": {
                    one.source: _stream(one) for one in found.streams if one.table == total.table
                },
            }
            for total in found.totals()
        ],
        "streams_only_a": [list(key) for key in found.only_a],
        "streams_only_b": [list(key) for key in found.only_b],
        "constellation": None if constellation is None else _constellation(constellation),
        "missing": found.missing,
        "remarks": found.remarks,
    }
    plain: dict[str, Any] = _finite(document)
    return plain


def _stream(found: StreamDifference) -> dict[str, Any]:
    return {
        "table": found.table,
        "by": found.by,
        "rows": [found.rows_a, found.rows_b],
        "matched": found.matched,
        "identical": found.is_identical,
        "only_a": _alone(found.only_a),
        "only_b": _alone(found.only_b),
        "fields": {name: _field(one) for name, one in found.fields.items()},
        "fields_only_a": list(found.fields_only_a),
        "fields_only_b": list(found.fields_only_b),
    }


def _alone(alone: Alone) -> dict[str, Any]:
    return {"count": alone.count, "first": _place(alone.first), "last": _place(alone.last)}


def _field(found: FieldDifference) -> dict[str, Any]:
    return {
        "unit": found.field.unit,
        "different": found.different,
        "compared": found.compared,
        "null_in_one": found.null_in_one,
        "rms": found.rms,
        "max": found.max if found.compared else None,
        "at": _place(found.at),
        "first": _place(found.first),
        "values": None if found.values is None else list(found.values),
    }


def _place(place: Place | None) -> dict[str, Any] | None:
    return None if place is None else {"key": place.key, "who": place.who}


def _constellation(found: ConstellationDifference) -> dict[str, Any]:
    total = found.all_positions()
    truth = None
    if total is not None:
        truth = {
            "all": _position(total),
            "agents": {name: _position(one) for name, one in found.positions.items()},
            "over_time": [_stretch(row, "m") for row in found.over_time],
        }
    return {
        "frame": list(found.frame),
        "truth": truth,
        "slots": [[dataclasses.asdict(row) for row in rows] for rows in found.slots],
        "measurements": _measurements(found),
        "control": _pairs(found.efforts, _effort, total_effort),
        "estimates": _pairs(found.slot_errors, _slot_error, total_slot_error)
        | {"over_time": [[_stretch(r, "deg") for r in rows] for rows in found.slot_over_time]},
        "remarks": found.remarks,
    }


def _pairs(
    pair: tuple[Mapping[str, Any], Mapping[str, Any]],
    told: Callable[[Any], Any],
    total: Callable[[Any], Any],
) -> dict[str, Any]:
    agents = dict.fromkeys((*pair[0], *pair[1]))
    return {
        "all": [told(total(one)) for one in pair],
        "agents": {name: [told(one.get(name)) for one in pair] for name in agents},
    }


def _position(found: PositionDifference) -> dict[str, Any]:
    return {
        "count": found.count,
        "rms_m": found.rms_m,
        "max_m": found.max_m,
        "max_t_s": found.max_t_s,
        "last_m": found.last_m,
        **{f"{axis}_rms_m": value for axis, value in zip(AXES, found.axes_m(), strict=True)},
    }


def _effort(effort: Effort | None) -> dict[str, Any] | None:
    return None if effort is None else dataclasses.asdict(effort)


def _measurements(found: ConstellationDifference) -> list[dict[str, Any]]:
    a, b = found.measurements
    return [
        {
            "sensor": key[0],
            "quantity": key[1],
            "unit": (a.get(key) or b[key]).unit,
            "errors": [_error(one.get(key)) for one in (a, b)],
        }
        for key in dict.fromkeys((*a, *b))
    ]


def _error(error: MeasurementError | None) -> dict[str, Any] | None:
    return None if error is None else {"count": error.count, "rms": error.rms, "max": error.max}


def _slot_error(error: SlotError | None) -> dict[str, Any] | None:
    if error is None:
        return None
    return {
        "rms_deg": error.rms_deg,
        "settled_rms_deg": error.settled_rms_deg,
        "last_deg": error.last_deg,
        "count": error.count,
    }


def _stretch(row: Sequence[float], unit: str) -> dict[str, float]:
    return {"t_s": row[0], f"rms_{unit}": row[1], f"max_{unit}": row[2]}


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
