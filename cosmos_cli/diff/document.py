"""
A comparison as JSON: what `cosmos diff --json` prints, schema 1. Pure.

    schema, runs {a, b}, same, identical
    settings, versions, summaries    lists of {key, a, b}; null where a run does not have the key
    timing                           {key of run.json: [a, b]}
    streams                          one per stream: {table, by, rows [a, b], matched, identical, only_a, only_b, fields,
                                     fields_only_a, fields_only_b, sources}; sources hold the same of each agent or machine
        only_a, only_b               {count, first {key, who}, last {key, who}}
        fields                       {name: {unit, different, compared, null_in_one, rms, max, at {key, who}, first, values}}
    streams_only_a, streams_only_b   lists of [table, source]
    the simulation's name            what its `compare` tells; absent without one
    missing, remarks                 lists of sentences

Of more than two runs: schema, first, same, identical, and comparisons, a list of these, each with the first run as a.

A key is a tick where `by` is tick, a time in s where it is time, and the number of the record where it is order.
Differences are those of the second run from the first; a number that is not finite is null.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from cosmos_cli.diff.compare import Comparison
from cosmos_cli.diff.fields import FieldDifference, RecordPlace
from cosmos_cli.diff.stream import StreamDifference

SCHEMA = 1


def to_document(found: Comparison) -> dict[str, Any]:
    """Return the comparison as plain mappings, lists and scalars."""
    own = found.by_simulation
    document = {
        "schema": SCHEMA,
        "runs": {"a": found.a.run.name, "b": found.b.run.name},
        "simulation": found.a.simulation,
        "same": found.is_same,
        "identical": found.is_identical,
        "settings": [asdict(one) for one in found.settings],
        "versions": [asdict(one) for one in found.versions],
        "summaries": [asdict(one) for one in found.summaries],
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
        **({} if own is None else {found.simulation: own.document}),
        "missing": found.missing,
        "remarks": found.remarks,
    }
    plain: dict[str, Any] = _finite(document)
    return plain


def several_documents(documents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return several comparisons with one run as one mapping: each stands in `comparisons` as it would alone."""
    return {
        "schema": SCHEMA,
        "first": documents[0]["runs"]["a"],
        "same": all(one["same"] for one in documents),
        "identical": all(one["identical"] for one in documents),
        "comparisons": list(documents),
    }


def _stream(found: StreamDifference) -> dict[str, Any]:
    return {
        "table": found.table,
        "by": found.by,
        "rows": [found.rows_a, found.rows_b],
        "matched": found.matched,
        "identical": found.is_identical,
        "only_a": asdict(found.only_a),
        "only_b": asdict(found.only_b),
        "fields": {name: _field(one) for name, one in found.fields.items()},
        "fields_only_a": list(found.fields_only_a),
        "fields_only_b": list(found.fields_only_b),
    }


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


def _place(place: RecordPlace | None) -> dict[str, Any] | None:
    return None if place is None else asdict(place)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
