"""Simulated time zero by the clock of whoever recorded: a board may keep a time that is years off."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from cosmos_cli.evidence.run_log import posix_s
from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.tables import RecordedTable
from madns_runtime.conditions.condition import TIME

UTC: Final = "utc"
SAMPLES_MAX: Final = 100
"""Records of one source and table that are looked at: the first that tell both times."""
BATCH_RECORDS: Final = 4096


def zeros_s(tables: Iterable[RecordedTable | None]) -> dict[str, float]:
    """
    Return simulated time zero by the clock of each source, as a POSIX time, s: the median of what its records tell.

    Args:
        tables: Of streams whose records bear `t_s` and `utc` of one moment, such as events; None for one that is not there.
    """
    told: dict[str, list[float]] = {}
    for table in tables:
        if table is not None and table.has(TIME, UTC):
            for source in table.sources:
                told.setdefault(source, []).extend(_zeros_told(table, source))
    return {source: float(np.median(zeros)) for source, zeros in told.items() if zeros}


def _zeros_told(table: RecordedTable, source: str) -> list[float]:
    found: list[float] = []
    for columns in table.batches(source, (TIME, UTC), BATCH_RECORDS):
        times_s = as_array(columns[TIME])
        for place in np.flatnonzero(np.isfinite(times_s)).tolist():
            zero_s = posix_s(columns[UTC][place]) - float(times_s[place])
            if np.isfinite(zero_s):
                found.append(zero_s)
            if len(found) == SAMPLES_MAX:
                return found
    return found
