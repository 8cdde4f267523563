"""Expectations as a person writes them under `checks:`, and what is wrong with one by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge
from pydantic import Field

from cosmos_cli.models.text_forms import NonBlank, like
from cosmos_cli.models.value_rules import (
    BOUND_WORDS,
    BoundsRule,
    FieldRule,
    RuleFault,
    words_at,
)

CHECKS_MAX = 1000
CheckName = Annotated[
    str,
    like(
        r"[A-Za-z][A-Za-z0-9._-]{0,63}",
        "a name of letters, digits, '.', '_' and '-' that begins with a letter, at most 64",
    ),
]
Seconds = Annotated[float, Ge(0)]
Statistic = Literal[
    "each",
    "last",
    "max",
    "min",
    "mean",
    "rms",
    "sd",
    "p99",
    "count",
    "rate",
    "first_time",
    "settled",
]
OF_VALUES = ("each", "last", "max", "min", "mean", "rms", "sd", "p99")
"""Statistics in the field's unit."""
OF_TIMES = ("first_time", "settled")
"""Statistics in s."""
OF_NUMBERS = ("count", "rate")
FRAMEWORKS_OWN = (
    "agents.", "deadline.", "devices.", "hardware.", "messages.", "records.", "summary.", "time.",
)  # fmt: skip
"""Begin the names of checks that every run has."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckRule(BoundsRule):
    """An expectation: a statistic of a recorded field with a limit, or an event that must or must not occur."""

    __written_names__ = {"while_": "while"}

    name: CheckName
    """Name of the check in results."""
    stream: NonBlank | None = None
    """Stream whose records count; of an event `events` if not given."""
    field: NonBlank | None = None
    """Field of it; of an event the one that holds the word, `event` if not given."""
    agents: tuple[NonBlank, ...] = ()
    """Names, labels or globs of agents; host for the host's half. Not given: all agents, or the host's half where it alone records the stream."""
    statistic: Statistic | None = None
    """Which of the values are compared; each if not given, last with at_end."""
    unit: str = ""
    """Unit of the limit, or of the bounds under `when`; the field's own if not given."""
    when: BoundsRule | None = None
    """Bounds of the value that first_time and settled wait for, and of those that count and rate count."""
    from_s: Seconds | None = None
    """Records before this simulated time do not count."""
    to_s: Seconds | None = None
    """Records after it do not, either."""
    at_end: bool = False
    """Whether only the last record of each agent counts."""
    while_: Annotated[FieldRule | None, Field(alias="while")] = None
    """Records count only while this holds, by its newest record of the same agent, or of the host's half."""
    event: NonBlank | None = None
    """A word that the stream records when something happens."""
    must: Literal["occur", "not_occur"] | None = None
    """Whether the event must occur, or must not; occur if not given."""
    before_s: Seconds | None = None
    """Latest simulated time of the event."""
    after: CheckName | None = None
    """An event, or a first_time, named further up: what comes before it does not count."""
    within_s: Seconds | None = None
    """Latest time of the event after that of `after`."""
    stop_when_broken: bool = False
    """Whether the run ends as soon as this is broken, with exit code 4."""

    @property
    def kind(self) -> Statistic:
        """The statistic, the one that is meant where none is given."""
        return self.statistic or ("last" if self.at_end else "each")

    def own_faults(self) -> Iterator[RuleFault]:
        """Yield what is wrong with the rule by itself."""
        if self.name.startswith(FRAMEWORKS_OWN):
            yield ("name",), f"checks named {self.name.split('.')[0]}.* are the framework's own"
        if self.to_s is not None and self.from_s is not None and self.to_s < self.from_s:
            yield ("to_s",), f"expected >= from_s ({self.from_s:g}), got {self.to_s:g}"
        yield from self._event_faults() if self.event is not None else self._value_faults()

    def _event_faults(self) -> Iterator[RuleFault]:
        text = "is of a field's values, and an event has none: leave out event, or this"
        for word in (*BOUND_WORDS, "statistic", "when", "while_"):
            if getattr(self, word) is not None:
                yield (word.rstrip("_"),), text
        for word in ("tolerance", "unit", "at_end"):
            if getattr(self, word):
                yield (word,), text
        if self.within_s is not None and self.after is None:
            yield ("within_s",), "counts from another event: name it under after"
        if self.before_s is not None and self.from_s is not None and self.before_s < self.from_s:
            yield ("before_s",), f"expected >= from_s ({self.from_s:g}), got {self.before_s:g}"
        if self.stop_when_broken and (self.must != "not_occur" or self.after is not None):
            text = "goes with must: not_occur, without after: that an event is missing is known at the end"
            yield ("stop_when_broken",), text

    def _value_faults(self) -> Iterator[RuleFault]:
        kind = self.kind
        for word in ("must", "before_s", "after", "within_s"):
            if getattr(self, word) is not None:
                yield (word,), "is of an event: give its word under event, or leave this out"
        if self.stream is None:
            yield (), "expected a stream, or an event"
        elif self.field is None and kind not in OF_NUMBERS:
            yield (), f"expected a field of stream {self.stream}"
        yield from self.bounds_faults()
        if self.when is not None:
            yield from words_at(("when",), self.when.bounds_faults())
            if kind in OF_VALUES:
                yield ("when",), f"goes with {_listed((*OF_TIMES, *OF_NUMBERS))}, not with {kind}"
            elif self.field is None:
                yield ("when",), "bounds a field's value: expected a field"
        elif kind in OF_TIMES:
            yield ("statistic",), f"{kind} needs when: the bounds that the value is to be within"
        elif self.unit and kind in OF_NUMBERS:
            yield ("unit",), f"a {kind} has none, and there is no when that it could be of"
        if self.while_ is not None:
            yield from words_at(("while",), self.while_.bounds_faults())
            if kind == "rate":
                yield ("while",), "does not go with a rate, which is of a whole stretch of time"
        if self.at_end and kind != "last":
            yield (
                ("at_end",),
                f"is the last record of each agent: expected statistic last, got {kind}",
            )
        if self.stop_when_broken:
            yield from self._stop_faults()

    def _stop_faults(self) -> Iterator[RuleFault]:
        path = ("stop_when_broken",)
        can_break = {
            "each": True,
            "max": self.above is None,
            "min": self.below is None,
            "count": self.above is None,
        }
        if not can_break.get(self.kind, False):
            yield (
                path,
                f"expected a check that one record can break (each; max below; min above; count below), got"
                f" {self.kind} {self.word}: it is known at the end",
            )
        if self.while_ is not None or self.at_end:
            yield path, "goes with neither while nor at_end"


def _listed(words: tuple[str, ...]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}"


def expected_words(rule: CheckRule, stream: str, field: str, unit: str) -> str:
    """Return what a rule expects of a stream and a field, as a person reads it; *unit* is the field's own."""
    when = _times(rule)
    if rule.event is not None:
        must = "must not occur" if rule.must == "not_occur" else "must occur"
        by = f" by {rule.before_s:g} s" if rule.before_s is not None else ""
        within = f" within {rule.within_s:g} s" if rule.within_s is not None else ""
        after = f"{within} after {rule.after}" if rule.after else ""
        return f"{rule.event} in {stream} {must}{by}{after}{when}"
    what = f"{stream}.{field}" if field else stream
    own = rule.unit or unit
    if rule.kind in OF_TIMES:
        assert rule.when is not None
        return f"{rule.kind} of {what} {rule.when.words(own)}: {rule.words('s')}{when}"
    if rule.kind in OF_NUMBERS:
        counted = "" if rule.when is None else f" {rule.when.words(own)}"
        return f"{rule.kind} of {what}{counted}: {rule.words('1/s' if rule.kind == 'rate' else '')}{when}"
    statistic = "last" if rule.at_end else rule.kind
    return f"{statistic} of {what} {rule.words(own)}{when}"


def _times(rule: CheckRule) -> str:
    text = "" if rule.from_s is None else f" from {rule.from_s:g} s"
    text += "" if rule.to_s is None else f" to {rule.to_s:g} s"
    if rule.while_ is None:
        return text
    held = rule.while_
    return f"{text} while {held.stream}.{held.field} {held.words(held.unit)}"
