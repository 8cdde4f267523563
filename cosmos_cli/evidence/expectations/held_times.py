"""Times at which a condition on another stream holds, for expectations that count only meanwhile."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cosmos_cli.evidence.expectations.accumulators import Flags, Floats, holds
from cosmos_cli.evidence.expectations.records import Batch, RecordSource
from cosmos_cli.models.expectation import HeldBounds, owner_of, scaled
from madns_runtime.conditions.condition import HOST
from madns_runtime.units import conversion

CHANGES_MAX = 1_000_000
"""Changes of one agent between holding and not that are kept; records, of one whose times go back."""


class TooManyChanges(Exception):
    """A condition changes too often to be followed; the text says which."""


class HeldTimes:
    """
    When a condition holds, by agent.

    Args:
        held: The condition.
        source: Where its records come from.

    Raises:
        TooManyChanges: It changes more often than CHANGES_MAX times, or its times go back among more records.
    """

    def __init__(self, held: HeldBounds, source: RecordSource) -> None:
        self._changes: dict[str, list[tuple[Floats, Flags]]] = {}
        self._counts: dict[str, int] = {}
        self._newest_s: dict[str, float] = {}
        self._goes_back: set[str] = set()
        """Agents whose records are not in the order of their times, as of messages that overtook each other."""
        self._own: set[str] = set()
        """Agents that recorded it themselves: what the host's half records of them under that name is not looked at."""
        self._names_agents = False
        """Whether the host's half says of whom its records are: none of them is of an agent that they do not name."""
        for batch, states in self._batches(held, source):
            self._add(batch, states, held)
        if self._goes_back:
            self._put_in_order(held, source)

    def during(self, agent: str, t_s: Floats) -> Flags:
        """Tell of each time whether the newest record of the condition until then holds."""
        changes = self._changes.get(owner_of(agent))
        if changes is None and not self._names_agents:
            changes = self._changes.get(HOST)
        if not changes:
            return np.zeros(len(t_s), bool)
        if len(changes) > 1:
            joined = tuple(np.concatenate(parts) for parts in zip(*changes, strict=True))
            changes[:] = [(joined[0], joined[1])]
        times, states = changes[0]
        place = np.searchsorted(times, t_s, side="right") - 1
        return (place >= 0) & states[np.maximum(place, 0)]

    def _batches(self, held: HeldBounds, source: RecordSource) -> Iterator[tuple[Batch, Flags]]:
        """Yield records that have the field, and of each whether the condition holds; none whose unit is of something else."""
        for batch in source.batches(held.stream, (held.field,)):
            self._names_agents = self._names_agents or (batch.is_of_host and batch.agent != HOST)
            unit = source.unit_of(held.stream, held.field, batch.agent)
            factor = conversion(held.unit or unit, unit)
            if batch.has(held.field) and factor is not None:
                batch = batch.of(held.field)
                yield batch, holds(scaled(held.bounds, factor), batch.values)

    def _add(self, batch: Batch, states: Flags, held: HeldBounds) -> None:
        if not len(states):
            return
        agent = owner_of(batch.agent)
        if not batch.is_of_host:
            self._own.add(agent)
        elif agent in self._own:
            return
        newest_s = np.maximum.accumulate(np.append(self._newest_s.get(agent, 0.0), batch.t_s))
        self._newest_s[agent] = float(newest_s[-1])
        if (batch.t_s < newest_s[:-1]).any():
            self._goes_back.add(agent)
        known = self._changes.setdefault(agent, [])
        before = known[-1][1][-1] if known else not states[0]
        changed = np.flatnonzero(np.diff(states, prepend=before))
        if len(changed):
            known.append((batch.t_s[changed], states[changed]))
        count = self._counts[agent] = self._counts.get(agent, 0) + len(changed)
        if count > CHANGES_MAX:
            raise TooManyChanges(
                f"{held.stream}.{held.field} of {batch.agent} changes more than {CHANGES_MAX} times between holding and not"
            )

    def _put_in_order(self, held: HeldBounds, source: RecordSource) -> None:
        """Follow those anew whose times go back, by all of their records: what is between two changes counts, too."""
        kept: dict[str, list[tuple[Floats, Flags]]] = {agent: [] for agent in self._goes_back}
        counts = dict.fromkeys(kept, 0)
        for batch, states in self._batches(held, source):
            agent = owner_of(batch.agent)
            if agent not in kept or (batch.is_of_host and agent in self._own):
                continue
            kept[agent].append((batch.t_s, states))
            counts[agent] += len(batch.t_s)
            if counts[agent] > CHANGES_MAX:
                raise TooManyChanges(
                    f"{held.stream}.{held.field} of {batch.agent} has more than {CHANGES_MAX} records, and their times go back"
                )
        for agent, parts in kept.items():
            times, states = (np.concatenate(columns) for columns in zip(*parts, strict=True))
            order = np.argsort(times, kind="stable")
            self._changes[agent] = [(times[order], states[order])]
