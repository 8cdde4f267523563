"""
Counts of records whose files have no end line to tell them, as the host was told at the run's end: no disk took it.

Pure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cosmos_cli.evidence.datagrams import whole_count
from cosmos_cli.evidence.streams import StreamScan
from madns_runtime.conditions.condition import HOST
from madns_runtime.plain_values import mapping_at


def with_told_counts(
    scans: Sequence[StreamScan], result: Mapping[str, Any] | None
) -> tuple[StreamScan, ...]:
    """
    Return scans with what was told of files that were cut.

    Args:
        scans: What is there.
        result: What the host reported; None if it could not.
    """
    return tuple(scan if scan.promised is not None else _as_told(scan, result) for scan in scans)


def _as_told(scan: StreamScan, result: Mapping[str, Any] | None) -> StreamScan:
    file = scan.file
    who = ("agents", file.source) if file.role == "agent" else ()
    told = mapping_at(result, *who, "records", "streams", file.stream)
    if file.role not in ("agent", HOST) or told.get("file") != file.path.name:
        return scan  # of an earlier incarnation, say
    dropped, not_finite = whole_count(told.get("dropped")), whole_count(told.get("not_finite"))
    return replace(scan, dropped=max(dropped, 0), not_finite=max(not_finite, 0))
