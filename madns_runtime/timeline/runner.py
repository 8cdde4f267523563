"""A timeline while its run goes on: what is due at a simulated time, what ends then, what was ordered. Pure."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from madns_runtime.timeline.action import ActionKind, TimelineAction
from madns_runtime.timeline.dispatcher import Dispatcher
from madns_runtime.timeline.entries import ScheduledEntry
from madns_runtime.timeline.schedule import DueAction, schedule
from madns_runtime.written_times import later_s

ORDERS_MAX: Final = 10_000
"""Actions of one run that are ordered live; more are refused."""


TIMES_BITS: Final = 32
"""Of an action's chance: place of its entry, above how many actions this had before."""


def chance_of(entry: int | None, before: int) -> int:
    """
    Return what an action's chance is drawn for: whatever else takes place in the run, its chance is the same.

    Args:
        entry: Place of its entry in the timeline; None for one that was ordered live.
        before: Actions of this entry, or those ordered live, that came before it.
    """
    return -2 - before if entry is None else entry + (before << TIMES_BITS)


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderedAction:
    """An action that is ordered while the run goes on."""

    word: str
    agents: tuple[str, ...] = ()
    parameters: Mapping[str, Any]
    for_s: float | None = None
    entry: int | None = None
    """Place in the timeline; None for one that is ordered live."""

    @classmethod
    def of_entry(cls, place: int, entry: ScheduledEntry, agents: tuple[str, ...]) -> OrderedAction:
        """Return an action of an entry of the timeline."""
        return cls(
            word=entry.action,
            agents=agents,
            parameters=entry.parameters,
            for_s=entry.for_s,
            entry=place,
        )


class TimelineRunner:
    """
    Begins and ends actions.

    Args:
        entries: Of the timeline.
        kinds: By word, of all actions of this run.
        dispatcher: To their handlers.
        seed: The run's.
        duration_s: The run's, s.
    """

    def __init__(
        self,
        entries: Sequence[ScheduledEntry],
        kinds: Mapping[str, ActionKind],
        dispatcher: Dispatcher,
        *,
        seed: int,
        duration_s: float,
    ) -> None:
        self._entries = entries
        self._kinds = kinds
        self._dispatcher = dispatcher
        self._due: tuple[DueAction, ...] = schedule(entries, seed=seed, duration_s=duration_s)
        self._position = 0
        self._ends: list[tuple[float, int, TimelineAction]] = []
        self._count = self._ordered_count = 0
        self._counts: Counter[int | None] = Counter()
        """Actions by entry; None for those that were ordered live."""
        self._is_closed = False
        self._met: set[int] = set()
        """Conditions that were met: by one agent, others do not count any more."""

    @property
    def next_s(self) -> float | None:
        """Simulated time at which something is due; None if nothing is."""
        times = [self._due[self._position].t_s] if self._position < len(self._due) else []
        times += [self._ends[0][0]] if self._ends else []
        return min(times, default=None)

    @property
    def in_force(self) -> tuple[TimelineAction, ...]:
        """Actions that have begun and not ended."""
        return self._dispatcher.in_force

    def told_in_force(self) -> list[dict[str, Any]]:
        """Return what is in force in plain values."""
        return [
            {
                "number": action.number,
                "action": action.word,
                "agents": list(action.agents),
                "parameters": dict(action.parameters),
                "since_s": action.t_s,
                "for_s": action.for_s,
            }
            for action in self.in_force
        ]

    def run_due(self, now_s: float, *, until_s: float = math.inf) -> None:
        """
        Do all that is due up to now, in the order of times; at one time what ends comes first.

        Args:
            now_s: Simulated time, s.
            until_s: The end of the run, s: what is due behind it never takes place.
        """
        due_by_s = min(now_s, until_s)
        while (next_s := self.next_s) is not None and next_s <= due_by_s:
            if self._ends and self._ends[0][0] <= next_s:
                due_s, _, action = heapq.heappop(self._ends)
                self._dispatcher.end(action, due_s, now_s)
                continue
            due = self._due[self._position]
            self._position += 1
            ordered = OrderedAction.of_entry(due.entry, self._entries[due.entry], due.agents)
            self._begin(ordered, due.t_s, now_s, is_known=True)

    def resume(self, agent: str) -> None:
        """Let what is in force go on at an agent that has returned."""
        self._dispatcher.resume(agent)

    def close(self) -> None:
        """Let nothing more begin or end: the run's simulated time is over."""
        self._position = len(self._due)
        self._ends.clear()
        self._is_closed = True

    def met(self, condition: int, met_s: float, now_s: float) -> None:
        """Begin, now, the actions that wait for a condition, which was met at *met_s*, as its record says; the first time alone."""
        if condition in self._met:
            return
        self._met.add(condition)
        due_s = met_s if met_s < now_s else now_s  # a record may bear a time to come, or none
        for place, entry in enumerate(self._entries):
            if entry.condition == condition and not self._is_closed:
                ordered = OrderedAction.of_entry(place, entry, entry.agents)
                self._begin(ordered, due_s, now_s)

    def order(self, ordered: OrderedAction, now_s: float) -> str:
        """Begin an action that is ordered live, at simulated time *now_s*, s; return why it is refused, "" if it takes place."""
        if self._is_closed:
            return "the run is ending"
        if self._ordered_count >= ORDERS_MAX:
            return f"at most {ORDERS_MAX} actions may be ordered in one run"
        self._ordered_count += 1
        return self._begin(ordered, now_s, now_s)

    def _begin(
        self, ordered: OrderedAction, due_s: float, now_s: float, *, is_known: bool = False
    ) -> str:
        action = TimelineAction(
            number=self._count,
            word=ordered.word,
            agents=ordered.agents,
            parameters=ordered.parameters,
            t_s=due_s,
            for_s=ordered.for_s,
            chance=chance_of(ordered.entry, self._counts[ordered.entry]),
        )
        self._count += 1
        self._counts[ordered.entry] += 1
        kind = self._kinds.get(ordered.word)
        lasts = kind is not None and (ordered.for_s is not None or kind.lasting == "may")
        refusal = self._dispatcher.begin(action, now_s, lasts=lasts)
        if not refusal and lasts and ordered.for_s is not None and not self._is_closed:
            end_s = later_s(due_s, ordered.for_s)
            # What the timeline knows beforehand ends when it says, though it began a little late: what begins then comes
            # after it. What was asked for in the run, or came too late for that, lasts as long as it is to.
            if not is_known or end_s <= now_s:
                end_s = later_s(max(due_s, now_s), ordered.for_s)
            heapq.heappush(self._ends, (end_s, action.number, action))
        return refusal
