"""A scenario's rules of a recorded value: which stream and field, and the bounds of it. Shared by checks and timeline."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge

from cosmos_cli.models.text_forms import NonBlank
from madns_runtime.conditions.condition import ValueBounds
from madns_runtime.plain_values import FORBID_EXTRA
from madns_runtime.recording.records import Field
from madns_runtime.units import conversion, converted

BOUND_WORDS = ("below", "above", "within", "equals")
EXACT_MAX = 2**53
"""From here on two whole numbers may be one float."""
UNIT_CURE = "leave out unit, or write one that converts"
RulePath = tuple[str | int, ...]
RuleFault = tuple[RulePath, str]
"""The path within the rule, and what is wrong there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoundsRule:
    """Bounds of a value: one of below, above, within and equals."""

    __pydantic_config__ = FORBID_EXTRA

    below: float | None = None
    """Values less than this hold."""
    above: float | None = None
    """Values greater than this hold."""
    within: tuple[float, float] | None = None
    """Values from the first to the second hold, these included."""
    equals: float | bool | str | None = None
    """This number, truth value or text holds."""
    tolerance: Annotated[float, Ge(0)] = 0.0
    """How far from `equals` a number may be."""

    @property
    def word(self) -> str:
        """The one of BOUND_WORDS that is given; empty if none is."""
        return next((word for word in BOUND_WORDS if getattr(self, word) is not None), "")

    def bounds(self, factor: float = 1.0) -> ValueBounds:
        """Return the bounds of values in a unit, of which *factor* make one of the rule's."""
        if self.below is not None:
            return ValueBounds.below(converted(self.below, factor))
        if self.above is not None:
            return ValueBounds.above(converted(self.above, factor))
        if self.within is not None:
            return ValueBounds.within(*(converted(each, factor) for each in self.within))
        if isinstance(self.equals, str):
            return ValueBounds.equals(self.equals)
        value = converted(float(self.equals or 0.0), factor)
        return ValueBounds.equals(value, converted(self.tolerance, factor))

    def words(self, unit: str = "") -> str:
        """Return the rule in words, such as `below 0.5 m`."""
        behind = f" {unit}" if unit else ""
        if self.within is not None:
            return f"within {self.within[0]:.10g} and {self.within[1]:.10g}{behind}"
        value = getattr(self, self.word or "below")
        if isinstance(value, bool | str) or value is None:
            return f"{self.word} {str(value).lower() if isinstance(value, bool) else value}"
        around = f" within {self.tolerance:.10g}" if self.tolerance else ""
        return f"{self.word} {value:.10g}{around}{behind}"

    def bounds_faults(self) -> Iterator[RuleFault]:
        """Yield what is wrong with the bounds by themselves."""
        given = [word for word in BOUND_WORDS if getattr(self, word) is not None]
        if not given:
            yield (), f"expected a limit: one of {', '.join(BOUND_WORDS)}"
        for word in given[1:]:
            cure = (
                "a range is within: [low, high]" if given == ["below", "above"] else "leave one out"
            )
            yield (word,), f"expected one limit, got {given[0]} as well: {cure}"
        if self.within is not None and self.within[0] > self.within[1]:
            low, high = self.within
            yield ("within",), f"expected the lesser bound first, got [{low:g}, {high:g}]"
        if self.tolerance and (self.equals is None or isinstance(self.equals, str | bool)):
            yield ("tolerance",), "goes with equals and a number: leave it out"


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldRule(BoundsRule):
    """Bounds of a field of a stream."""

    stream: NonBlank
    """Stream whose records count."""
    field: NonBlank
    """Field of it."""
    unit: str = ""
    """Unit of the bounds; the field's own if not given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AwaitedRule(FieldRule):
    """Condition that is waited for in the records of some agents."""

    agents: tuple[NonBlank, ...] = ()
    """Names, labels or globs of agents; host for the host's half. Not given: all agents, or the host's half where it alone records the stream."""
    for_s: Annotated[float, Ge(0)] = 0.0
    """How long it must have held, s."""


def words_at(path: RulePath, faults: Iterator[RuleFault]) -> Iterator[RuleFault]:
    """Yield faults of a rule that stands below *path*."""
    for inner, text in faults:
        yield (*path, *inner), text


def field_names(kind: type) -> tuple[str, ...]:
    """Return the names of a rule's fields."""
    return tuple(item.name for item in dataclasses.fields(kind))


def kind_faults(rule: BoundsRule, field: Field | None) -> Iterator[RuleFault]:
    """Yield what does not fit between bounds and the kind of a field."""
    if field is None:
        return
    if field.kind == "str" and rule.word and not isinstance(rule.equals, str):
        yield (rule.word,), f"{field.name} holds texts: expected equals and one of them"
    elif field.kind != "str" and isinstance(rule.equals, str):
        kind = "true or false" if field.kind == "bool" else "a number"
        yield ("equals",), f"{field.name} holds no texts: expected {kind}, got {rule.equals!r}"
    elif field.kind in ("float", "int") and isinstance(rule.equals, bool):
        yield ("equals",), f"{field.name} holds numbers, got {str(rule.equals).lower()}"
    elif field.kind == "int" and _is_blurred(rule):
        text = "whole numbers from 2^53 on are compared as floats, to which neighbours are one"
        yield ("equals",), f"{text}: expected within: [low, high], or a tolerance"


def _is_blurred(rule: BoundsRule) -> bool:
    is_number = isinstance(rule.equals, int | float)
    return is_number and not rule.tolerance and abs(float(rule.equals or 0.0)) >= EXACT_MAX


def unit_faults(unit: str, field: Field | None, *, must_know: bool = False) -> Iterator[RuleFault]:
    """Yield what does not fit between a unit that is given and a field's; *must_know* if it is needed in the run."""
    if not unit:
        return
    if field is None:
        if must_know:
            yield (
                ("unit",),
                "with stop_when_broken the field's unit must be declared: leave out unit",
            )
        return
    if conversion(unit, field.unit) is None:
        has = f"is in {field.unit}" if field.unit else "has no unit"
        yield ("unit",), f"{field.name} {has}, got {unit!r:.40}: {UNIT_CURE}"


def range_faults(rule: BoundsRule, unit: str, field: Field | None) -> Iterator[RuleFault]:
    """Yield that bounds in *unit* are no finite numbers in the field's: to a condition in the run they would be none."""
    factor = None if field is None else conversion(unit or field.unit, field.unit)
    if field is None or factor is None:
        return
    for word in (*BOUND_WORDS, "tolerance"):
        value = getattr(rule, word)
        for each in value if isinstance(value, tuple) else (value,):
            if isinstance(each, int | float) and math.isinf(converted(each, factor)):
                yield (word,), f"{each:g} {unit} is more than a number in {field.unit} can tell"
