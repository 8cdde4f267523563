"""An expectation as it is judged: whose records, what of them, and the limit. A value that travels in plan.json. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from madns_runtime.conditions.condition import HOST, Condition, ValueBounds
from madns_runtime.units import converted

TIMES_MAX: Final = 2**53
"""Records that a condition counts: no run has so many, and every whole number up to it travels as it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldBounds:
    """Condition that has to hold meanwhile for a record to count."""

    stream: str
    field: str
    bounds: ValueBounds
    """In `unit`, or in the field's own."""
    unit: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """One expectation of a run."""

    name: str
    words: str
    """Words for what is expected, such as `max of drive.error_m below 0.5 m`."""
    stream: str
    field: str = ""
    """Empty for a count of records."""
    agents: tuple[str, ...]
    """Names; host for the records of the host's half; of a device's stream full names of devices, such as agent-02/imu.
    Empty: of all machines or devices that recorded it."""
    is_of_host: bool = False
    """Whether the host's half records it of agents, which its field `agent` names."""
    statistic: str = "each"
    bounds: ValueBounds = ValueBounds()
    """Of the statistic, in `unit`, s, or a number."""
    unit: str = ""
    """Unit of the values; the field's own if empty."""
    when: ValueBounds | None = None
    """Bounds of the value, in `unit`."""
    from_s: float | None = None
    to_s: float | None = None
    meanwhile: HeldBounds | None = None
    event: str = ""
    """Word that a record holds in `field`; empty where values are judged."""
    has_known_words: bool = False
    """Whether all texts of `field` are known: then none that is looked for is misspelt."""
    must: Literal["occur", "not_occur"] = "occur"
    after: str = ""
    within_s: float | None = None
    only_realtime: bool = False
    """Whether no run in lockstep records the stream."""
    stop_when_broken: bool = False
    unit_factor: float = 1.0
    """Values in the field's declared unit that one of `unit` makes: for conditions in the run."""

    @property
    def is_timed(self) -> bool:
        """Whether it is about the times of records."""
        times = (self.from_s, self.to_s, self.meanwhile, self.within_s, self.after or None)
        is_of_times = self.statistic in ("first_time", "settled")
        return is_of_times or any(each is not None for each in times)

    def is_judged_in(self, *, is_lockstep: bool) -> bool:
        """Tell whether runs of a time mode record what it is about."""
        return not (self.only_realtime and is_lockstep)


def conditions_of_checks(
    expectations: Sequence[Expectation], first: int = 0
) -> tuple[Condition, ...]:
    """Return the conditions that break, in the run, expectations which it is to end with; numbers go up from *first*."""
    found = [
        condition for each in expectations if each.stop_when_broken for condition in _breaking(each)
    ]
    return tuple(replace(each, number=first + place) for place, each in enumerate(found))


def _breaking(expectation: Expectation) -> Iterator[Condition]:
    bounds, times = _broken_bounds(expectation)
    condition = Condition(
        number=0,
        name=expectation.name,
        stream=expectation.stream,
        field=expectation.field,
        bounds=bounds,
        times=times,
        from_s=expectation.from_s,
        to_s=expectation.to_s,
        ends_run=True,
    )
    if expectation.is_of_host:
        yield replace(condition, agents=expectation.agents, is_of_host=True)
        return
    agents = tuple(name for name in expectation.agents if name != HOST)
    if agents:
        yield replace(condition, agents=agents)
    if HOST in expectation.agents:
        yield replace(condition, agents=(HOST,), is_of_host=True)


def _broken_bounds(expectation: Expectation) -> tuple[ValueBounds, int]:
    """Return the bounds of a value that breaks an expectation, in the field's unit, and in how many records."""
    bounds, factor = expectation.bounds, expectation.unit_factor
    if expectation.event:
        return ValueBounds.equals(expectation.event), 1
    if expectation.statistic == "count":
        high = bounds.high or 0.0
        times = math.floor(high) + 1 if bounds.is_closed else math.ceil(high)
        counted = ValueBounds() if expectation.when is None else scaled(expectation.when, factor)
        return counted, min(max(1, times), TIMES_MAX)
    if expectation.statistic == "max":
        bounds = replace(bounds, low=None)
    elif expectation.statistic == "min":
        bounds = replace(bounds, high=None)
    return scaled(bounds, factor).negated(), 1


def owner_of(name: str) -> str:
    """Return the agent, or the machine, of a device's full name; of any other name itself."""
    return name.partition("/")[0]


def scaled(bounds: ValueBounds, factor: float) -> ValueBounds:
    """Return the bounds of values in another unit, *factor* of which make one of these."""
    low, high = (
        None if each is None else converted(each, factor) for each in (bounds.low, bounds.high)
    )
    return replace(bounds, low=low, high=high)


def unjudged_remark(expectations: Sequence[Expectation], *, is_lockstep: bool) -> str:
    """Return in words that runs of a time mode can judge none of these, and end without a result; empty where some are."""
    unjudged: set[str] = set()
    for each in expectations:
        if each.after in unjudged or not each.is_judged_in(is_lockstep=is_lockstep):
            unjudged.add(each.name)
    if not unjudged or len(unjudged) < len(expectations):
        return ""
    return (
        f"none can be judged, such as {expectations[0].name}: runs in lockstep do not record its stream, and this one"
        " would end as DATA INCOMPLETE; add a check of another stream, or fly in real time"
    )
