"""Remarks on what a scenario's timeline asked for and the run did not do: refused, or never come to. Pure but for `told_events`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import orjson

from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.plural import counted
from madns_runtime.analysis.tables import RecordedTable, Tables
from madns_runtime.config import RunConfig
from madns_runtime.recording.records import EVENTS
from madns_runtime.timeline.dispatcher import BEGAN, REFUSED

MET: Final = "condition_met"
BATCH_RECORDS: Final = 65_536
SHOWN_MAX: Final = 5
"""Refusals of one word, and conditions that were never met, that are told one by one."""


def timeline_remarks(config: RunConfig | None, tables: Tables) -> tuple[str, ...]:
    """
    Return a remark on the actions that were refused, by word, and on each condition that was never met.

    Args:
        config: The run; of one without a timeline what was ordered live is told.
        tables: Of it.
    """
    host = tables.get(f"host_{EVENTS.name}")
    if config is None or not (config.timeline or any(told_events(host, BEGAN, REFUSED))):
        return ()
    met = {str(event.get("condition")) for _, event in told_events(host, MET)}
    never = [
        f"{config.conditions[entry.condition].name} ({entry.action}): its condition was never met"
        for entry in config.timeline
        if entry.condition is not None and config.conditions[entry.condition].name not in met
    ]
    if len(never) > SHOWN_MAX:
        more = counted(len(never) - SHOWN_MAX, "more condition")
        never[SHOWN_MAX:] = [f"timeline: {more} never met"]
    return (*_refusals(tables), *never)


def _refusals(tables: Tables) -> Iterator[str]:
    """Yield a remark per word of refused actions, with the first reason."""
    counts: Counter[str] = Counter()
    first: dict[str, str] = {}
    for name in (f"host_{EVENTS.name}", EVENTS.name):
        for source, event in told_events(tables.get(name), REFUSED):
            word = str(event.get("action"))
            counts[word] += 1
            first.setdefault(word, f"{source}: {event.get('reason')}")
    for word, count in counts.items():
        by = " by" if count == 1 else ", first by"
        yield clean_line(f"timeline: {word} was refused {counted(count, 'time')}{by} {first[word]}")


def told_events(
    table: RecordedTable | None, *words: str
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the details of all events of some words, each with who recorded it."""
    if table is None or not table.has("event", "details"):
        return
    for source in table.sources:
        for columns in table.batches(source, ("event", "details"), BATCH_RECORDS):
            for place in np.isin(columns["event"], words).nonzero()[0].tolist():
                found = orjson.loads(columns["details"][place] or "{}")
                yield source, found if isinstance(found, dict) else {}
