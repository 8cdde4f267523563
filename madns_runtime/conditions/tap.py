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
Read = Callable[[str], Any]
"""Reads a field of one record by its name."""
When = Callable[[Read], float | None]
"""Returns the simulated time that a record tells, s; None or not finite where it tells none."""
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
        seconds: str = "",
    ) -> Take | None:
        """
        Return what is to be given every record of a stream; None if no condition names it.

        Args:
            stream: Its name.
            fields: Of its records, in their order.
            earlier: Returns the records of earlier incarnations, by field; called if a condition counts them.
            seconds: The first of the fields that is a float in s: where there is neither t_s nor a tick it tells, to
                conditions that count records of some times alone, when a record is of.
        """
        own = self._by_stream.get(stream)
        if not own:
            return None
        places = {name: place for place, name in enumerate(fields)}
        when, window = (
            self._time_of(fields),
            _Window(self._judged_by(fields, seconds), self._present_s),
        )
        has_agents = self._source == HOST and AGENT in places
        evaluators: dict[str, list[ConditionEvaluator]] = {}
        # Of a stream that names agents, too, all records are the host's half's own.
        whole = self._evaluators(
            self._source, [each for each in own if not has_agents or HOST in each.agents]
        )
        self._recall(whole, window, earlier)

        def take(record: Any) -> None:
            if isinstance(record, Mapping):
                read: Read = record.get
            else:
                read = lambda name: record[places[name]] if name in places else None  # noqa: E731 - one of two
            times = self._own_or_present_s(when(read)), window.of(read)
            self._give(self._source, whole, times, read)
            if has_agents:
                who = str(read(AGENT))
                if (following := evaluators.get(who)) is None:
                    named = [each for each in own if who in each.agents and who != HOST]
                    following = evaluators[who] = self._evaluators(who, named)
                self._give(who, following, times, read)

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
        window: _Window,
        earlier: Callable[[], Iterable[Mapping[str, Any]]],
    ) -> None:
        counting = [each for each in evaluators if each.wants_earlier]
        self._counting += counting
        for each in counting:
            each.count = self._counted.get(each.condition.number, 0)
        counting = [each for each in counting if each.condition.number not in self._counted]
        for record in earlier() if counting else ():
            t_s = window.of(record.get)
            for each in counting:
                field = each.condition.field
                each.recall(t_s, record.get(field) if field else 1.0)
            if not any(each.wants_earlier for each in counting):
                return

    def _give(
        self,
        who: str,
        following: Sequence[ConditionEvaluator],
        times: tuple[float | None, float | None],
        read: Read,
    ) -> None:
        t_s, judged_s = times
        for evaluator in following:
            condition = evaluator.condition
            value = read(condition.field) if condition.field else 1.0
            own_s = judged_s if condition.is_timed else t_s
            self._note(who, evaluator, evaluator.take(own_s, value))

    def _note(self, who: str, evaluator: ConditionEvaluator, met_s: float | None) -> None:
        if met_s is not None:
            self._report(evaluator.condition.number, who, met_s)

    def _time_of(self, fields: Sequence[str]) -> When:
        """Return what reads a record's simulated time: from its field t_s, its tick, or the clock."""
        if TIME in fields:
            return lambda read: _seconds(read(TIME))
        if TICK in fields and self._source != HOST:
            return lambda read: _seconds(read(TICK), self._tick_hz)
        return lambda read: self._present_s()

    def _judged_by(self, fields: Sequence[str], seconds: str) -> When:
        """Return what reads the time by which whoever judges the run tells which records count: of some, that they were sent at."""
        has_own = TIME in fields or (TICK in fields and self._source != HOST)
        if has_own or not seconds:
            return self._time_of(fields)
        return lambda read: _seconds(read(seconds))

    def _own_or_present_s(self, t_s: float | None) -> float | None:
        """Return a record's time, 0 before it runs; the present of one that tells none, or one that is null on record."""
        return max(t_s, 0.0) if t_s is not None and math.isfinite(t_s) else self._present_s()

    def _present_s(self) -> float | None:
        now_s = self._now_s()
        return None if now_s is None else max(now_s, 0.0)


class _Window:
    """
    The times by which it is told which records of a stream count, as they are judged after the run.

    A record that tells none is of the begin; behind one that does, it is of the present, as the next one is.
    """

    def __init__(self, when: When, present_s: Callable[[], float | None]) -> None:
        self._when = when
        self._present_s = present_s
        self._has_told = False

    def of(self, read: Read) -> float | None:
        """Return the time of the next record, s; None for that of the begin."""
        t_s = self._when(read)
        if t_s is None or not math.isfinite(t_s):
            return self._present_s() if self._has_told else None
        self._has_told = True
        return max(t_s, 0.0)


def _seconds(value: Any, per_s: float = 1.0) -> float | None:
    try:
        return float(value) / per_s
    except (TypeError, ValueError):
        return None
