"""The expectations of a scenario: what is wrong with them among its agents and streams, and what is judged. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.check_rules import OF_NUMBERS, OF_TIMES, CheckRule, expected_words
from cosmos_cli.models.device_uses import named_agents
from cosmos_cli.models.document import did_you_mean
from cosmos_cli.models.expectation import Expectation, HeldBounds, owner_of
from cosmos_cli.models.known_streams import REAL_TIME_ONLY, KnownStreams
from cosmos_cli.models.plugin_answers import PluginAnswers
from cosmos_cli.models.scenario import Scenario
from cosmos_cli.models.value_rules import (
    BoundsRule,
    FieldRule,
    RuleFault,
    kind_faults,
    range_faults,
    unit_faults,
    words_at,
)
from madns_runtime.conditions.condition import HOST, ValueBounds
from madns_runtime.recording.records import EVENTS, Field
from madns_runtime.units import conversion

EVENT_FIELD = "event"


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """Subjects of checks."""

    agents: tuple[str, ...]
    labels: AgentLabels
    streams: KnownStreams
    duration_s: float


@dataclass(frozen=True, slots=True)
class ResolvedChecks:
    """The expectations that are meant, and what is wrong."""

    expectations: tuple[Expectation, ...]
    faults: tuple[RuleFault, ...]
    """Paths within the list of checks."""


def resolve_checks(
    rules: Sequence[CheckRule], around: Surroundings, places: Sequence[int] | None = None
) -> ResolvedChecks:
    """
    Return what is judged by the checks of a scenario.

    Args:
        rules: As they are written.
        around: The agents and streams that they are about.
        places: Of each in the list, if others have faults of their own and are not among them; None for all.
    """
    faults: list[RuleFault] = []
    found: list[Expectation] = []
    earlier: dict[str, CheckRule] = {}
    for index, rule in zip(range(len(rules)) if places is None else places, rules, strict=True):
        among = _faults_among(rule, earlier, is_whole=places is None)
        own = [*rule.own_faults(), *among, *_Placing(rule, around).faults()]
        faults += words_at((index,), iter(own))
        earlier.setdefault(rule.name, rule)
        if not own:
            expectation = _Placing(rule, around).expectation()
            faults += words_at((index,), _faults_of_order(expectation, found))
            found.append(expectation)
    return ResolvedChecks(tuple(found), tuple(faults))


def scenario_checks(
    scenario: Scenario,
    answers: PluginAnswers,
    streams: KnownStreams,
    places: Sequence[int] | None,
) -> ResolvedChecks:
    """
    Return what the checks of a scenario expect; nothing while it is open which agents there are.

    Args:
        scenario: The scenario.
        answers: Of its simulation; while its parameters have faults, any stream may be one of it.
        streams: That it, its devices and the framework record.
        places: As `resolve_checks` takes them.
    """
    if answers.labels is None:
        return ResolvedChecks((), ())
    agents = scenario.agents.resolved_names()
    around = Surroundings(
        agents=agents,
        labels=answers.labels,
        streams=streams,
        duration_s=scenario.time.duration_s,
    )
    return resolve_checks(scenario.checks, around, places)


def _faults_among(
    rule: CheckRule, earlier: dict[str, CheckRule], *, is_whole: bool
) -> Iterator[RuleFault]:
    if rule.name in earlier:
        yield ("name",), f"expected unique names, got {rule.name!r} again"
    if rule.after is None:
        return
    other = earlier.get(rule.after)
    timed = [each.name for each in earlier.values() if _has_time(each)]
    if other is None and not is_whole:
        return  # it may be one with faults of its own
    if other is None:
        text = f"no check above is named {rule.after!r}{did_you_mean(rule.after, timed)}"
        yield ("after",), text
    elif not _has_time(other):
        text = f"{rule.after} has no time: expected an event that must occur, or a first_time"
        yield ("after",), text


def _has_time(rule: CheckRule) -> bool:
    if rule.event is not None:
        return rule.must != "not_occur"
    return rule.kind == "first_time"


def _faults_of_order(rule: Expectation, found: Sequence[Expectation]) -> Iterator[RuleFault]:
    """Yield that some agents have nothing to come after: the event further up is another agent's, of several."""
    other = next((each for each in found if rule.after and each.name == rule.after), None)
    if other is None or len(other.agents) <= 1 or HOST in other.agents:
        return
    owners = {owner_of(name) for name in other.agents}
    alone = [name for name in rule.agents if owner_of(name) not in owners]
    if alone:
        text = f"{rule.after} is of {named_agents(other.agents)}, and this of {named_agents(alone)} too"
        yield ("after",), f"{text}: name agents of both, or one agent alone, or host, further up"


class _Placing:
    """One rule among agents and streams."""

    def __init__(self, rule: CheckRule, around: Surroundings) -> None:
        self._rule, self._around = rule, around
        self._stream = rule.stream or EVENTS.name
        self._field = rule.field or (EVENT_FIELD if rule.event is not None else "")
        self._streams = around.streams
        if rule.agents:
            self._streams = around.streams.used_by(
                around.labels.like_any(rule.agents, around.agents)
            )
        self._roles = around.streams.roles(self._stream)
        self._is_apart = around.streams.is_apart(self._stream)

    def faults(self) -> Iterator[RuleFault]:
        rule, streams = self._rule, self._streams
        yield from self._time_faults()
        if fault := streams.stream_fault(self._stream):
            yield ("stream",), fault
            return
        if streams.is_unasked(self._stream, rule.while_.stream if rule.while_ else self._stream):
            return
        yield from self._apart_faults() if self._is_apart else self._agent_faults()
        if rule.stop_when_broken and (fault := streams.apart_fault(self._stream, self._field)):
            yield ("stop_when_broken",), fault
        if not streams.has_time(self._stream):
            yield from self._timeless_faults()
        if self._field and (fault := streams.field_fault(self._stream, self._field)):
            yield ("field",), fault
        elif self._field:
            yield from self._value_faults(streams.field(self._stream, self._field))
        if rule.while_ is not None:
            yield from words_at(("while",), self._while_faults(rule.while_))

    def _time_faults(self) -> Iterator[RuleFault]:
        rule, end_s = self._rule, self._around.duration_s
        if rule.from_s is not None and rule.from_s >= end_s:
            text = f"expected less than time.duration_s ({end_s:g}), got {rule.from_s:g}"
            yield ("from_s",), f"{text}: nothing is recorded then"
            return
        begin_s, last_s = rule.from_s or 0.0, min(end_s, end_s if rule.to_s is None else rule.to_s)
        if rule.kind == "rate" and rule.event is None and last_s <= begin_s:
            text = f"expected more than from_s ({begin_s:g}), got {last_s:g}"
            yield ("to_s",), f"{text}: a rate is of a stretch of time"
        if rule.kind in OF_TIMES and rule.word and not rule.bounds().overlap(begin_s, last_s):
            text = f"a {rule.kind} here is from {begin_s:g} s to {last_s:g} s"
            yield (rule.word,), f"{text}: {rule.words('s')} never holds"
        elif rule.kind in OF_NUMBERS and rule.word and not rule.bounds().overlap(0.0, math.inf):
            yield (rule.word,), f"a {rule.kind} is never less than 0: {rule.words()} never holds"
        elif rule.kind == "count" and rule.word and not rule.bounds().hold_a_whole_number():
            yield (rule.word,), f"a count is a whole number: {rule.words()} never holds"

    def _timeless_faults(self) -> Iterator[RuleFault]:
        rule = self._rule
        text = f"records of stream {self._stream} tell no time"
        for word in ("from_s", "to_s", "while_", "before_s", "after", "within_s"):
            if getattr(rule, word) is not None:
                yield (word.rstrip("_"),), f"{text}: leave this out"
        if rule.kind in OF_TIMES:
            yield ("statistic",), f"{text}: expected another than {rule.kind}"

    def _agent_faults(self) -> Iterator[RuleFault]:
        around, streams = self._around, self._around.streams
        for place, pattern in enumerate(self._rule.agents):
            path = ("agents", place)
            if pattern == HOST:
                if "host" not in self._roles:
                    yield (
                        path,
                        f"stream {self._stream} is recorded by agents, not by the host's half",
                    )
                elif len(self._rule.agents) > 1 and "agent" not in self._roles:
                    text = "expected host alone, for all records of its half, or agents"
                    yield path, f"{text}: write two checks"
            elif not around.labels.like(pattern, around.agents):
                yield path, f"no agent is named {pattern}{did_you_mean(pattern, around.agents)}"
            elif self._roles == {"host"} and not streams.names_agents(self._stream):
                text = f"stream {self._stream} is recorded by the host's half and names no agent"
                yield path, f"{text}: leave out agents"

    def _apart_faults(self) -> Iterator[RuleFault]:
        """Yield what is wrong with whose records of machines or devices are meant."""
        stream, around = self._stream, self._around
        sources = around.streams.sources(stream)
        for place, pattern in enumerate(self._rule.agents):
            path = ("agents", place)
            if self._roles == {"machine"}:
                if pattern != HOST:
                    text = (
                        f"stream {stream} is recorded per machine: leave out agents for all of them"
                    )
                    yield path, f"{text}, or write [host] for the host's computer alone"
            elif sources is None:
                text = (
                    f"stream {stream} is of a device of an inventory, in which its machines stand"
                )
                yield path, f"{text}: leave out agents"
            elif not around.labels.like(pattern, around.agents):
                yield path, f"no agent is named {pattern}{did_you_mean(pattern, around.agents)}"
            elif not self._devices([pattern]):
                yield path, f"{pattern} does not use what records {stream}: {named_agents(sources)}"

    def _devices(self, patterns: Sequence[str]) -> tuple[str, ...]:
        """Return the full names of the devices of some agents that record the stream."""
        around = self._around
        agents = set(around.labels.like_any(patterns, around.agents))
        sources = around.streams.sources(self._stream) or ()
        return tuple(name for name in sources if owner_of(name) in agents)

    def _value_faults(self, field: Field | None) -> Iterator[RuleFault]:
        rule = self._rule
        streams, stream = self._streams, self._stream
        if rule.event is not None:
            if field is not None and field.kind != "str":
                yield ("field",), f"{field.name} holds no words: an event is a word of a text field"
            elif fault := streams.word_fault(stream, self._field, rule.event, rule.agents):
                yield ("event",), fault
            return
        is_statistic = rule.kind in (*OF_TIMES, *OF_NUMBERS)
        bounded: BoundsRule | None = rule.when if is_statistic else rule
        below = ("when",) if is_statistic else ()
        if is_statistic and isinstance(rule.equals, str | bool):
            yield ("equals",), f"a {rule.kind} is a number, got {rule.equals!r}"
        if bounded is not None:
            yield from words_at(below, kind_faults(bounded, field))
            yield from words_at(below, range_faults(bounded, rule.unit, field))
            if fault := streams.kinds_fault(stream, self._field):
                yield ("field",), fault
            if fault := streams.word_fault(stream, self._field, bounded.equals, rule.agents):
                yield (*below, "equals"), fault
        if not is_statistic and isinstance(rule.equals, str) and rule.kind not in ("each", "last"):
            yield ("statistic",), f"a text has no {rule.kind}: expected each or last"
        elif field is not None and field.kind == "str" and rule.kind not in (
            "each", "last", *OF_NUMBERS, *OF_TIMES,
        ):  # fmt: skip
            yield ("statistic",), f"{field.name} holds texts, which have no {rule.kind}"
        yield from unit_faults(rule.unit, field, must_know=rule.stop_when_broken)

    def _while_faults(self, rule: FieldRule) -> Iterator[RuleFault]:
        streams = self._streams
        stream, name = rule.stream, rule.field
        if fault := streams.stream_fault(stream):
            yield ("stream",), fault
        elif fault := streams.field_fault(stream, name):
            yield ("field",), fault
        elif not streams.has_time(stream):
            text = f"records of stream {stream} tell no simulated time: name another"
            yield ("stream",), text
        elif fault := self._unlike_fault(stream):
            yield ("stream",), fault
        elif fault := streams.kinds_fault(stream, name):
            yield ("field",), fault
        else:
            field = streams.field(stream, name)
            yield from kind_faults(rule, field)
            yield from unit_faults(rule.unit, field)
            yield from range_faults(rule, rule.unit, field)
            if fault := streams.word_fault(stream, name, rule.equals, self._rule.agents):
                yield ("equals",), fault

    def _unlike_fault(self, held: str) -> str | None:
        """Return why it is not known whose records of the stream under `while` go with those that are judged."""
        streams = self._around.streams
        if streams.roles(held) == {"host"} and not streams.names_agents(held):
            return None
        is_of_host = HOST in self._agents(is_of_host=streams.names_agents(self._stream))
        if is_of_host and "host" not in streams.roles(held):
            return f"stream {held} is not recorded by the host's half, of whose records some are judged"
        if held == self._stream:
            return None
        for stream in (held, self._stream):
            if streams.is_apart(stream) and streams.sources(stream) is None:
                text = f"stream {stream} is of a device of an inventory, whose agents are not known here"
                return f"{text}: give while a stream that the host's half records"
        return None

    def expectation(self) -> Expectation:
        rule, around = self._rule, self._around
        is_of_host = (
            self._roles == {"host"}
            and around.streams.names_agents(self._stream)
            and HOST not in rule.agents
        )
        field = self._streams.field(self._stream, self._field)
        of = "" if field is None else field.unit
        held = rule.while_
        return Expectation(
            name=rule.name,
            words=expected_words(rule, self._stream, self._field, of),
            stream=self._stream,
            field=self._field,
            agents=self._agents(is_of_host=is_of_host),
            is_of_host=is_of_host,
            statistic=rule.kind,
            bounds=ValueBounds() if rule.event is not None else rule.bounds(),
            unit=self._streams.bounds_unit(self._stream, self._field, rule.unit),
            when=None if rule.when is None else rule.when.bounds(),
            from_s=rule.from_s,
            to_s=_earliest(rule.to_s, rule.before_s),
            meanwhile=None
            if held is None
            else HeldBounds(
                stream=held.stream,
                field=held.field,
                bounds=held.bounds(),
                unit=self._streams.bounds_unit(held.stream, held.field, held.unit),
            ),
            event=rule.event or "",
            has_known_words=bool(self._streams.words(self._stream, self._field)),
            must=rule.must or "occur",
            after=rule.after or "",
            within_s=rule.within_s,
            only_realtime=self._stream in REAL_TIME_ONLY
            or (held is not None and held.stream in REAL_TIME_ONLY),
            stop_when_broken=rule.stop_when_broken,
            unit_factor=(rule.unit and conversion(rule.unit, of)) or 1.0,
        )

    def _agents(self, *, is_of_host: bool) -> tuple[str, ...]:
        rule, around = self._rule, self._around
        if self._is_apart:
            if not rule.agents:
                return around.streams.sources(self._stream) or ()
            return (HOST,) if HOST in rule.agents else self._devices(rule.agents)
        if not rule.agents:
            return around.agents if is_of_host or "agent" in self._roles else (HOST,)
        chosen = around.labels.like_any(
            [pattern for pattern in rule.agents if pattern != HOST], around.agents
        )
        return (*chosen, *([HOST] if HOST in rule.agents else []))


def _earliest(*times_s: float | None) -> float | None:
    return min((each for each in times_s if each is not None), default=None)
