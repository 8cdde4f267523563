"""Numbers of the thesis's benchmark (its section 6.1 and appendix C): round trips by agent as agents and host saw them."""

from __future__ import annotations

from typing import Any

import numpy as np

from madns_runtime.analysis.distribution import Distribution
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.plain_values import is_real, mapping_at

ROUND_TRIP = "round_trip_us"
US_TO_MS = 1e-3
ROWS_MAX = 1_000_000
"""Records read at a time: those of a run of 8 h need not lie in memory side by side."""
ALL = "all"


def document(run: RecordedRun) -> dict[str, Any]:
    """Return "benchmark": round trips in ms by who saw them and agent, packets and ticks by agent."""
    by_agents = _seen_by_agents(run)
    by_host = _seen_by_host(run)
    rows = [*_rows("agent", by_agents), *_rows("host", by_host)]
    return {"benchmark": {"round_trips_ms": rows, "agents": _counts(run)}}


def _seen_by_agents(run: RecordedRun) -> dict[str, Distribution]:
    table = run.tables.get("round_trips")
    if table is None or not table.has(ROUND_TRIP):
        return {}
    found: dict[str, Distribution] = {}
    for agent in table.sources:
        found[agent] = Distribution()
        for columns in table.batches(agent, (ROUND_TRIP,), ROWS_MAX):
            found[agent].add(Distribution.of(columns[ROUND_TRIP]))
    return found


def _seen_by_host(run: RecordedRun) -> dict[str, Distribution]:
    table = run.tables.get("host_answer_round_trips")
    if table is None or not table.has(ROUND_TRIP, "agent"):
        return {}
    found: dict[str, Distribution] = {}
    for source in table.sources:
        for columns in table.batches(source, ("agent", ROUND_TRIP), ROWS_MAX):
            agents = columns["agent"].astype(str)
            for agent in np.unique(agents).tolist():
                samples = columns[ROUND_TRIP][agents == agent]
                found.setdefault(agent, Distribution()).add(Distribution.of(samples))
    return dict(sorted(found.items()))


def _rows(seen_by: str, by_agent: dict[str, Distribution]) -> list[dict[str, Any]]:
    """Return one row per agent and one for all of them together."""
    together = Distribution()
    for one in by_agent.values():
        together.add(one)
    rows = []
    for agent, distribution in {**by_agent, ALL: together}.items():
        summary = distribution.summary(US_TO_MS)
        if summary is not None:
            rows.append({"seen_by": seen_by, "agent": agent, **summary.to_mapping()})
    return rows


def _counts(run: RecordedRun) -> dict[str, dict[str, Any]]:
    """Return what each agent sent, got back and lost, its ticks and those that it missed."""
    tables = [run.tables.get("ticks"), run.tables.get("late_ticks")]
    ticks, late = [None if table is None or not table.has("missed") else table for table in tables]
    found: dict[str, dict[str, Any]] = {}
    for agent in mapping_at(run.document, "simulation", "agents"):
        own = run.agent_summary(agent)
        found[agent] = {key: own.get(key) for key in ("sent", "returned", "lost")}
        if ticks is not None:
            done, missed = _count(ticks, agent)
            # Those that no tick followed are told by the records of causes alone.
            told = _count(late, agent)[1]
            # Those of an agent that was gone are told by nobody, and run.json alone counts them.
            gone = mapping_at(run.document, "timing", "causes_by_agent", agent).get("absent")
            told += int(gone) if is_real(gone) else 0
            found[agent] |= {"ticks": done, "missed": max(missed, told)}
    return found


def _count(table: RecordedTable | None, agent: str) -> tuple[int, int]:
    """Return an agent's records, none of one that ran no tick, and the missed ticks that they tell of."""
    records = missed = 0
    if table is None or agent not in table.sources:
        return records, missed
    for columns in table.batches(agent, ("missed",), ROWS_MAX):
        records += len(columns["missed"])
        missed += int(np.nansum(columns["missed"]))
    return records, missed
