"""Conditions that entries of a timeline wait for, among the streams and agents of their run. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.document import did_you_mean
from cosmos_cli.models.known_streams import REAL_TIME_ONLY, KnownStreams
from cosmos_cli.models.value_rules import (
    AwaitedRule,
    RuleFault,
    kind_faults,
    range_faults,
    unit_faults,
)
from madns_runtime.conditions.condition import HOST, Condition
from madns_runtime.units import conversion


@dataclass(frozen=True, slots=True)
class AwaitedCondition:
    """One rule of what is waited for."""

    rule: AwaitedRule
    streams: KnownStreams
    names: tuple[str, ...]
    """Of all agents."""
    labels: AgentLabels
    is_lockstep: bool

    def faults(self) -> Iterator[RuleFault]:
        """Yield what is wrong with the rule."""
        rule, streams = self.rule, self.streams
        yield from rule.bounds_faults()
        if fault := streams.stream_fault(rule.stream):
            yield ("stream",), fault
            return
        if streams.is_unasked(rule.stream):
            return
        if fault := streams.apart_fault(rule.stream, rule.field):
            yield ("stream",), fault
            return
        if self.is_lockstep and rule.stream in REAL_TIME_ONLY:
            yield ("stream",), f"stream {rule.stream} is not recorded in time.mode lockstep"
        yield from self._agent_faults()
        if fault := streams.field_fault(rule.stream, rule.field):
            yield ("field",), fault
            return
        field = streams.field(rule.stream, rule.field)
        yield from kind_faults(rule, field)
        if fault := streams.word_fault(rule.stream, rule.field, rule.equals, rule.agents):
            yield ("equals",), fault
        if field is None and rule.unit:
            yield ("unit",), "the field's unit is not declared: leave out unit"
        else:
            yield from unit_faults(rule.unit, field)
            yield from range_faults(rule, rule.unit, field)

    def _agent_faults(self) -> Iterator[RuleFault]:
        rule, roles = self.rule, self.streams.roles(self.rule.stream)
        for place, pattern in enumerate(rule.agents):
            path = ("agents", place)
            if pattern == HOST:
                if "host" not in roles:
                    yield path, f"stream {rule.stream} is recorded by agents alone"
                if len(rule.agents) > 1:
                    yield path, "expected host alone, or agents: write two entries"
            elif not self.labels.like(pattern, self.names):
                yield path, f"no agent is named {pattern}{did_you_mean(pattern, self.names)}"
            elif roles == {"host"} and not self.streams.names_agents(rule.stream):
                yield path, f"stream {rule.stream} names no agent: leave out agents"

    def condition(self, number: int, name: str) -> Condition:
        """Return what is evaluated in the run."""
        rule, roles = self.rule, self.streams.roles(self.rule.stream)
        names_agents = roles == {"host"} and self.streams.names_agents(rule.stream)
        if rule.agents == (HOST,) or (roles == {"host"} and not names_agents):
            agents: tuple[str, ...] = (HOST,)
        else:
            agents = tuple(self.labels.like_any(rule.agents or ("*",), self.names))
        field = self.streams.field(rule.stream, rule.field)
        unit = "" if field is None else field.unit
        return Condition(
            number=number,
            name=name,
            stream=rule.stream,
            field=rule.field,
            bounds=rule.bounds((rule.unit and conversion(rule.unit, unit)) or 1.0),
            agents=agents,
            is_of_host=agents == (HOST,) or names_agents,
            for_s=rule.for_s,
        )
