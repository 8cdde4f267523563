"""A tap on the recorder of an agent, or of the host's half: hands what conditions name to their evaluators."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from madns_runtime.conditions.condition import AGENT, HOST, TICK, TIME, Condition, conditions_of
from madns_runtime.conditions.evaluator import ConditionEvaluator

Take = Callable[[Any], None]
"""Takes one record in its stream's shape: a sequence in the order of its fields, or a mapping."""
Report = Callable[[int, str, float], None]
"""Takes the number of a condition that is met, whose record it is, and the simulated time of it, s."""


class ConditionTap:
    """
    The conditions of one who records.

    Args:
        source: An agent's name, or `host`.
        conditions: All of the run.
        tick_hz: Rate of agents' ticks: a record of a tick is of its time.
        now_s: Returns the simulated time, s, for records that tell none; those before it runs are of its begin.
        report: Told of each condition that is met.
        counted: Of an earlier incarnation in this process what `counts` returned: its records are not read again.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        source: str,
        conditions: Sequence[Condition],
        *,
        tick_hz: float,
        now_s: Callable[[], float | None],
        report: Report,
        counted: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        self._source = source
        self._tick_hz = tick_hz
        self._now_s = now_s
        self._report = report
        self._by_stream: dict[str, list[Condition]] = {}
        for condition in conditions_of(source, conditions):
            self._by_stream.setdefault(condition.stream, []).append(condition)
        self._lasting: list[tuple[str, ConditionEvaluator]] = []
        self._counted = counted
        self._counting: list[ConditionEvaluator] = []

    def __bool__(self) -> bool:
        return bool(self._by_stream)

    def counts(self) -> dict[int, int]:
        """Return by number of a condition that counts in how many records it held so far."""
        own = {each.condition.number: each.count for each in self._counting}
        return {**self._counted, **own}

    @property
    def must_look(self) -> bool:
        """Whether conditions that have to hold for a while are open: `look` is to be called now and then."""
        return any(each.for_s > 0.0 for own in self._by_stream.values() for each in own)

    def open(
        self,
        stream: str,
        fields: Sequence[str],
        earlier: Callable[[], Iterable[Mapping[str, Any]]] = tuple,
    ) -> Take | None:
        """
        Return what is to be given every record of a stream; None if no condition names it.

        Args:
            stream: Its name.
            fields: Of its records, in their order.
            earlier: Returns the records of earlier incarnations, by field; called if a condition counts them.
        """
        own = self._by_stream.get(stream)
        if not own:
            return None
        places = {name: place for place, name in enumerate(fields)}
        when = self._time_of(fields)
        has_agents = self._source == HOST and AGENT in places
        evaluators: dict[str, list[ConditionEvaluator]] = {}
        # Of a stream that names agents, too, all records are the host's half's own.
        whole = self._evaluators(
            self._source, [each for each in own if not has_agents or HOST in each.agents]
        )
        self._recall(whole, when, earlier)

        def take(record: Any) -> None:
            if isinstance(record, Mapping):
                read: Callable[[str], Any] = record.get
            else:
                read = lambda name: record[places[name]] if name in places else None  # noqa: E731 - one of two
            t_s = when(read)
            self._give(self._source, whole, t_s, read)
            if has_agents:
                who = str(read(AGENT))
                if (following := evaluators.get(who)) is None:
                    named = [each for each in own if who in each.agents and who != HOST]
                    following = evaluators[who] = self._evaluators(who, named)
                self._give(who, following, t_s, read)

        return take

    def look(self, now_s: float) -> None:
        """Look at conditions that have to hold for a while, at simulated time *now_s*."""
        for who, evaluator in self._lasting:
            self._note(who, evaluator, evaluator.look(now_s))

    def _evaluators(self, who: str, conditions: Sequence[Condition]) -> list[ConditionEvaluator]:
        made = [ConditionEvaluator(each) for each in conditions]
        self._lasting += [(who, each) for each in made if each.condition.for_s > 0.0]
        return made

    def _recall(
        self,
        evaluators: Sequence[ConditionEvaluator],
        when: Callable[[Callable[[str], Any]], float | None],
        earlier: Callable[[], Iterable[Mapping[str, Any]]],
    ) -> None:
        counting = [each for each in evaluators if each.wants_earlier]
        self._counting += counting
        for each in counting:
            each.count = self._counted.get(each.condition.number, 0)
        counting = [each for each in counting if each.condition.number not in self._counted]
        for record in earlier() if counting else ():
            t_s = when(record.get)
            for each in counting:
                field = each.condition.field
                each.recall(t_s, record.get(field) if field else 1.0)
            if not any(each.wants_earlier for each in counting):
                return

    def _give(
        self,
        who: str,
        following: Sequence[ConditionEvaluator],
        t_s: float | None,
        read: Callable[[str], Any],
    ) -> None:
        is_timeless = t_s is not None and not math.isfinite(t_s)
        for evaluator in following:
            condition = evaluator.condition
            value = read(condition.field) if condition.field else 1.0
            # On record such a time is null, which counts as 0 where a condition, and who judges the run, looks at times.
            own_s = (None if condition.is_timed else self._present_s()) if is_timeless else t_s
            self._note(who, evaluator, evaluator.take(own_s, value))

    def _note(self, who: str, evaluator: ConditionEvaluator, met_s: float | None) -> None:
        if met_s is not None:
            self._report(evaluator.condition.number, who, met_s)

    def _time_of(self, fields: Sequence[str]) -> Callable[[Callable[[str], Any]], float | None]:
        """Return what reads a record's simulated time: from its field t_s, its tick, or the clock."""
        if TIME in fields:
            return lambda read: _seconds(read(TIME))
        if TICK in fields and self._source != HOST:
            return lambda read: _seconds(read(TICK), self._tick_hz)
        return lambda read: self._present_s()

    def _present_s(self) -> float | None:
        now_s = self._now_s()
        return None if now_s is None else max(now_s, 0.0)


def _seconds(value: Any, per_s: float = 1.0) -> float | None:
    try:
        return float(value) / per_s
    except (TypeError, ValueError):
        return None
