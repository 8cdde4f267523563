"""Judges expectations over a run's tables: one pass per stream, one result per expectation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.evidence.expectations.accumulators import (
    Accumulator,
    Counted,
    FirstTime,
    Last,
    Mean,
    Occurrences,
    Percentile99,
    Settled,
    StandardDeviation,
    Unlike,
    Worst,
)
from cosmos_cli.evidence.expectations.held_times import HeldTimes, TooManyChanges
from cosmos_cli.evidence.expectations.outcomes import (
    ExpectationOutcome,
    outcome_of_event,
    remark_on_end,
    why_not_flown,
    worst_result,
)
from cosmos_cli.evidence.expectations.records import Batch, RecordSource
from cosmos_cli.evidence.expectations.seen_words import SeenWords
from cosmos_cli.evidence.expectations.strangers import Strangers
from cosmos_cli.evidence.verdict import CheckResult
from cosmos_cli.models.check_rules import OF_NUMBERS, OF_TIMES
from cosmos_cli.models.expectation import Expectation, HeldBounds, owner_of, scaled
from cosmos_cli.models.known_streams import REAL_TIME_ONLY
from madns_runtime.analysis.tables import Tables
from madns_runtime.conditions.condition import HOST, ValueBounds
from madns_runtime.units import conversion, converted

RATE_UNIT = "1/s"
_Earlier = tuple[str, Mapping[str, ExpectationOutcome]]
"""The stream of an expectation further up, and what its agents came to."""
NOBODY = ""
"""Stands for the machines or devices that should have recorded a stream, and of which there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedExpectations:
    """Results of a run's expectations."""

    results: tuple[CheckResult, ...] = ()
    """Results of the expectations that were judged, in their order."""
    not_judged: Mapping[str, str] = field(default_factory=dict)
    """Why the others were not judged, by name."""
    unseen: tuple[str, ...] = ()
    """Remarks on words that are looked for and that no record has, where any may come: they may be misspelt."""
    of_strangers: tuple[str, ...] = ()
    """Remarks on records about names that are no agents: expectations of agents do not judge them."""
    of_ends: tuple[str, ...] = ()
    """Remarks on times that are asked for and that lie in part behind the run's end."""

    def remarks(self) -> tuple[str, ...]:
        """Return a remark per expectation that was not judged, per event whose word is nowhere, on records left out, and on times not flown."""
        told = (f"{name}: not judged: {why}" for name, why in self.not_judged.items())
        return (*told, *self.unseen, *self.of_strangers, *self.of_ends)

    def told_not_judged(self) -> list[dict[str, str]]:
        """Return the same as run.json holds it."""
        return [{"name": name, "why": why} for name, why in self.not_judged.items()]

    def document(self) -> dict[str, Any]:
        """Return the key of run.json that lists them; nothing if all were judged."""
        return {"checks_not_judged": self.told_not_judged()} if self.not_judged else {}

    def gaps(self) -> tuple[str, ...]:
        """Return what is missing of a run none of whose expectations was judged."""
        if self.results or not self.not_judged:
            return ()
        name, why = next(iter(self.not_judged.items()))
        return (f"checks: none of {len(self.not_judged)} was judged, such as {name}: {why}",)


def judge_expectations(
    expectations: Sequence[Expectation],
    tables: Tables,
    *,
    agents: Sequence[str],
    is_lockstep: bool,
    duration_s: float,
) -> JudgedExpectations:
    """
    Judge expectations over all records.

    Args:
        expectations: Of the run, in their order.
        tables: The run's.
        agents: Names of its agents.
        is_lockstep: Its time mode.
        duration_s: Simulated time that it had, s.
    """
    source = RecordSource(tables)
    not_judged = _not_judged(expectations, is_lockstep=is_lockstep)
    judged = [each for each in expectations if each.name not in not_judged]
    followed = [_Followed(each, source, duration_s) for each in judged]
    by_stream: dict[str, list[_Followed]] = {}
    strangers = Strangers(agents)
    for each in followed:
        by_stream.setdefault(each.expectation.stream, []).append(each)
    for stream, own in by_stream.items():
        fields = list(dict.fromkeys(each.expectation.field for each in own))
        for batch in source.batches(stream, [name for name in fields if name]):
            _give(batch, own)
            strangers.take(stream, batch)
        for each in filter(_Followed.begins_again, own):
            for batch in source.batches(stream, [each.expectation.field]):
                _give(batch, [each])
    earlier: dict[str, _Earlier] = {}
    results = []
    for each in followed:
        outcomes = each.outcomes(earlier)
        earlier[each.expectation.name] = each.expectation.stream, outcomes
        result = worst_result(each.expectation, outcomes, each.unit, duration_s=duration_s)
        results.append(
            result if source.has_time(each.expectation.stream) else replace(result, t_s=None)
        )
    return JudgedExpectations(
        results=tuple(results),
        not_judged=not_judged,
        unseen=tuple(filter(None, (each.words.remark() for each in followed))),
        of_strangers=tuple(strangers.remarks(judged)),
        of_ends=tuple(filter(None, (remark_on_end(each, duration_s) for each in judged))),
    )


def _not_judged(expectations: Sequence[Expectation], *, is_lockstep: bool) -> dict[str, str]:
    """Return why expectations are not judged, by name: of a stream that is not recorded, or after one of these."""
    found: dict[str, str] = {}
    for each in expectations:
        if not each.is_judged_in(is_lockstep=is_lockstep):
            found[each.name] = _of_other_mode(each)
        elif each.after in found:
            found[each.name] = f"it comes after {each.after}, which is not judged"
    return found


def _of_other_mode(expectation: Expectation) -> str:
    held = expectation.meanwhile
    is_held = held is not None and held.stream in REAL_TIME_ONLY
    stream = held.stream if held is not None and is_held else expectation.stream
    return f"stream {stream} is recorded in real time alone, and this run was in lockstep"


def _give(batch: Batch, followed: Sequence[_Followed]) -> None:
    """Give a batch to those that look at its agent, and its words to those that miss one; each field is cleaned once."""
    clean: dict[str, Batch | None] = {}
    for each in followed:
        is_about = each.is_about(batch)
        if not (is_about or each.words.is_sought):
            continue
        name = each.expectation.field
        if name not in clean:
            clean[name] = batch.all() if not name else batch.of(name) if batch.has(name) else None
        if (found := clean[name]) is not None:
            each.words.take(found.values)
            if is_about:
                each.take(found)


class _Followed:
    """One expectation on its way through the records."""

    def __init__(self, expectation: Expectation, source: RecordSource, duration_s: float) -> None:
        self.expectation = expectation
        self._names = expectation.agents or source.sources_apart(expectation.stream)
        self._agents = frozenset(self._names)
        self._records = source.records_of(expectation.stream)
        self._end_s = min(duration_s, duration_s if expectation.to_s is None else expectation.to_s)
        """End of the stretch of time that a rate is of, s."""
        self._has_stream = bool(source.tables_of(expectation.stream))
        self._fault = _fault_of(expectation, source)
        self._not_flown = why_not_flown(expectation, duration_s)
        units = {
            name: source.unit_of(expectation.stream, expectation.field, name)
            for name in self._names or (NOBODY,)
        }
        recorded = next(iter(units.values()))
        self._factors: dict[str, float] = {}
        """Values in each one's own unit that one in the unit of the bounds makes."""
        for name, unit in units.items():
            factor = (
                conversion(expectation.unit or recorded, unit) if _has_unit(expectation) else 1.0
            )
            if factor is None:
                self._fault = f"{expectation.field} is in {unit or '1'}"
            self._factors[name] = factor or 1.0
        self.unit = self._unit(recorded)
        self._accumulators: dict[str, Accumulator] = {}
        self.words = SeenWords(expectation)
        self._held: HeldTimes | None = None
        if expectation.meanwhile is not None:
            try:
                self._held = HeldTimes(expectation.meanwhile, source)
            except TooManyChanges as error:
                self._fault = str(error)

    def _unit(self, recorded: str) -> str:
        expectation = self.expectation
        if expectation.event or expectation.statistic in OF_TIMES:
            return "" if expectation.must == "not_occur" else "s"
        if expectation.statistic in OF_NUMBERS:
            return RATE_UNIT if expectation.statistic == "rate" else ""
        return "" if expectation.bounds.text is not None else expectation.unit or recorded

    def is_about(self, batch: Batch) -> bool:
        """Tell whether a batch is of its agents."""
        if batch.agent not in self._agents or self._fault is not None:
            return False
        return batch.is_of_host == (self.expectation.is_of_host or batch.agent == HOST)

    def take(self, batch: Batch) -> None:
        """Take a batch of records that have its field."""
        expectation = self.expectation
        wanted = np.ones(len(batch.t_s), bool)
        if expectation.from_s is not None:
            wanted &= batch.t_s >= expectation.from_s
        if expectation.statistic == "rate":
            # From 2 s to 5 s are 30 ticks at 10 Hz, not 31; a device goes on before and after.
            wanted &= batch.has_begun & (batch.t_s < self._end_s)
        elif expectation.to_s is not None and not expectation.event:
            wanted &= batch.t_s <= expectation.to_s
        if self._held is not None:
            wanted &= self._held.during(batch.agent, batch.t_s)
        is_text = bool(expectation.event or _text_of(expectation))
        values = batch.values
        if values.dtype == object and not is_text and expectation.field:
            wanted &= _are_numbers(values) | (expectation.statistic in OF_NUMBERS)
        batch = batch.where(wanted)
        if not len(batch.t_s):
            return
        accumulator = self._accumulators.get(batch.agent)
        if accumulator is None:
            accumulator = self._accumulators[batch.agent] = self._accumulator(batch.agent)
        accumulator.take(batch.t_s, batch.values, batch.places)

    def begins_again(self) -> bool:
        """Begin anew and return True where all records must come once more, for a time that was not kept."""
        settled = [each for each in self._accumulators.values() if isinstance(each, Settled)]
        if not any(each.must_look_again for each in settled):
            return False
        for each in settled:
            each.look_again()
        return True

    def _accumulator(self, agent: str) -> Accumulator:  # noqa: PLR0911 - a table of what each statistic is
        expectation = self.expectation
        bounds = self._bounds(agent)
        if expectation.event:
            return Occurrences(expectation.event)
        when = None if expectation.when is None else scaled(expectation.when, self._factors[agent])
        match expectation.statistic:
            case "last":
                return Last(bounds)
            case "mean" | "rms":
                return Mean(1 if expectation.statistic == "mean" else 2)
            case "sd":
                return StandardDeviation()
            case "p99":
                return Percentile99(self._records)
            case "count" | "rate":
                window_s = max(0.0, self._end_s - (expectation.from_s or 0.0))
                per_s = window_s if expectation.statistic == "rate" else 1.0
                return Counted(when, per_s)
            case "first_time":
                return FirstTime(when or bounds)
            case "settled":
                return Settled(when or bounds)
            case "max":
                return Worst(ValueBounds(high=0.0))
            case "min":
                return Worst(ValueBounds(low=0.0))
            case _:
                return Unlike(bounds) if bounds.text is not None else Worst(bounds)

    def _bounds(self, agent: str) -> ValueBounds:
        """Return the bounds of the statistic in the unit of an agent's records; times and numbers have their own."""
        expectation = self.expectation
        if expectation.statistic in (*OF_NUMBERS, *OF_TIMES):
            return expectation.bounds
        return scaled(expectation.bounds, self._factors[agent])

    def outcomes(self, earlier: Mapping[str, _Earlier]) -> dict[str, ExpectationOutcome]:
        """Return what each agent came to, given the same of the expectations before."""
        expectation = self.expectation
        after = earlier.get(expectation.after) if expectation.after else None
        found = {}
        for agent in self._names or (NOBODY,):
            accumulator = self._accumulators.get(agent)
            if accumulator is None and self._may_be_none:
                accumulator = self._accumulator(agent)
            found[agent] = self._outcome(agent, accumulator, after)
        return found

    @property
    def _may_be_none(self) -> bool:
        """Whether no record is an answer, too: of how many there are, and whether something happened."""
        is_counted = bool(self.expectation.event) or self.expectation.statistic in OF_NUMBERS
        is_answer = is_counted and not self._not_flown
        return is_answer and self._has_stream and self._fault is None

    def _outcome(
        self,
        agent: str,
        accumulator: Accumulator | None,
        after: _Earlier | None,
    ) -> ExpectationOutcome:
        expectation = self.expectation
        if isinstance(accumulator, Occurrences):
            stream, outcomes = after or ("", None)
            is_same = stream == expectation.stream
            return outcome_of_event(
                expectation, agent, accumulator, outcomes, is_same_stream=is_same
            )
        got, t_s = (None, None) if accumulator is None else accumulator.result()
        if got is None or not np.isfinite(got):
            return ExpectationOutcome(
                got=None, t_s=t_s, passed=False, why=self._fault or self._not_flown
            )
        bounds = self._bounds(agent)
        passed = got == 0.0 if bounds.text is not None else bounds.holds(got)
        is_value = expectation.statistic not in (*OF_NUMBERS, *OF_TIMES)
        shown = (
            converted(got, 1.0 / self._factors[agent]) if is_value and bounds.text is None else got
        )
        place = accumulator.place if isinstance(accumulator, FirstTime) else None
        return ExpectationOutcome(got=shown, t_s=t_s, passed=passed, place=place)


def _fault_of(expectation: Expectation, source: RecordSource) -> str | None:
    """
    Return why the records of a run cannot be judged; None if they can.

    Of a simulation that declares its streams, all this is refused before a run. Of another, no record would count,
    and what must not be would hold.
    """
    stream, field_ = expectation.stream, expectation.field
    roles = {table.role for table in source.tables_of(stream)}
    is_of_agents = not expectation.is_of_host and HOST not in expectation.agents
    if roles == {HOST} and is_of_agents:
        return f"stream {stream} is recorded by the host's half alone"
    if roles and field_ and not source.may_have(stream, field_):
        return f"stream {stream} has no field {field_}"
    if roles and expectation.is_timed and not source.has_time(stream):
        return f"records of stream {stream} tell no time"
    return (
        None
        if expectation.meanwhile is None
        else _held_fault(expectation, expectation.meanwhile, source)
    )


def _held_fault(expectation: Expectation, held: HeldBounds, source: RecordSource) -> str | None:
    """Return why it is not known when a condition under `while` holds; None if it is."""
    stream, field_ = held.stream, held.field
    if not source.tables_of(stream):
        return f"nobody recorded stream {stream}"
    if not source.may_have(stream, field_):
        return f"stream {stream} has no field {field_}"
    if not source.has_time(stream):
        return f"records of stream {stream} tell no time"
    owners, apart = {owner_of(name) for name in expectation.agents}, source.sources_apart(stream)
    held_by = [name for name in apart if not owners or owner_of(name) in owners]
    for name in held_by if apart else (NOBODY,):
        recorded = source.unit_of(stream, field_, name)
        if held.unit and conversion(held.unit, recorded) is None:
            return f"{stream}.{field_} is in {recorded or '1'}"
    return None


def _has_unit(expectation: Expectation) -> bool:
    """Tell whether bounds of an expectation are of a field's numbers, which have a unit."""
    is_counted = expectation.statistic in OF_NUMBERS and expectation.when is None
    return not (expectation.event or is_counted or _text_of(expectation))


def _text_of(expectation: Expectation) -> bool:
    bounds = expectation.when or expectation.bounds
    return bounds.text is not None


def _are_numbers(values: NDArray[Any]) -> NDArray[np.bool_]:
    return np.array([isinstance(each, int | float) for each in values.tolist()], bool)
