"""A scenario's timeline resolved: agents by name, actions that its time mode has, times within the run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cosmos_cli.errors import Fault
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.device_uses import named_agents
from cosmos_cli.models.document import Document, did_you_mean, dotted
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.known_streams import KnownStreams
from cosmos_cli.models.scenario import Scenario, SectionFault
from cosmos_cli.models.timeline_actions import ActionAnswers, KnownAction, entries_of
from cosmos_cli.models.timeline_conditions import AwaitedCondition
from cosmos_cli.models.timeline_rules import RULE_KEYS, TimelineRule
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.value_rules import words_at
from madns_runtime.conditions.condition import Condition
from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.fault_actions import ON_NUMBERS, check_fault
from madns_runtime.timeline.entries import ScheduledEntry
from madns_runtime.timeline.fault_kinds import LOSSES, MUST_CONTINUE, PARTITION
from madns_runtime.timeline.kinds import DEVICE_FAULT
from madns_runtime.timeline.schedule import ACTIONS_MAX, count_expected

EXPECTED_SHARE = 0.5
"""Of ACTIONS_MAX: chance may draw more than is expected."""


@dataclass(frozen=True, slots=True)
class ResolvedTimeline:
    """The entries as host and agents are told of them, and what is wrong."""

    entries: tuple[ScheduledEntry, ...] = ()
    faults: tuple[Fault, ...] = ()
    conditions: tuple[Condition, ...] = ()
    """Conditions that entries wait for; their numbers are places here."""
    actions: tuple[KnownAction, ...] = ()
    """All that may be named in it."""


NO_TIMELINE = ResolvedTimeline()


def resolve_timeline(
    document: Document,
    scenario: Scenario,
    answers: ActionAnswers,
    labels: AgentLabels | None,
    streams: KnownStreams,
) -> ResolvedTimeline:
    """
    Return a scenario's timeline among its agents and actions.

    Args:
        document: The scenario.
        scenario: What it says.
        answers: Actions that are known, and the parameters of each entry.
        labels: Second names of agents; None if they are not known, and then agents are not looked for.
        streams: That conditions may name.
    """
    faults: list[Fault] = []
    entries: list[ScheduledEntry] = []
    conditions: list[Condition] = []
    known = {action.word: action for action in answers.known}
    expected: dict[int, float] = {}
    for place, written in entries_of(document):
        if written is None:
            continue  # the model has said so already
        path: ValuePath = ("timeline", place)
        rule = _rule(document, path, written, faults)
        if rule is None:
            continue
        placing = _Placing(rule, scenario, known.get(rule.action), answers, labels)
        found = list(placing.faults())
        awaited = placing.awaited(streams)
        if awaited is not None:
            found += words_at(("when",), awaited.faults())
        faults += [document.fault((*path, *inner), text) for inner, text in found]
        given = answers.parameters[place] if place < len(answers.parameters) else None
        if found or given is None:
            continue
        entry = placing.entry(given)
        if awaited is not None:
            entry = replace(entry, condition=len(conditions))
            conditions.append(awaited.condition(len(conditions), dotted(path)))
        device_faults = _device_faults(scenario, entry, rule.agents, labels, streams)
        faults += [document.fault((*path, *inner), text) for inner, text in device_faults]
        entries.append(entry)
        expected[place] = count_expected(entry, scenario.time.duration_s)
    total = sum(expected.values())
    if total > EXPECTED_SHARE * ACTIONS_MAX:
        text = f"expected at most {EXPECTED_SHARE * ACTIONS_MAX:g} actions in a run, got some {total:.4g}"
        most = max(expected, key=lambda place: expected[place])
        told = f"{text}: make them rarer, most of all {dotted(('timeline', most))}"
        faults.append(document.fault(("timeline",), told))
    return ResolvedTimeline(tuple(entries), tuple(faults), tuple(conditions), answers.known)


@cache
def _rule_adapter() -> TypeAdapter[TimelineRule]:
    """Return what judges one entry; made once, and not for a scenario without a timeline: it takes milliseconds."""
    return TypeAdapter(TimelineRule)


def _rule(
    document: Document, path: ValuePath, written: Any, faults: list[Fault]
) -> TimelineRule | None:
    """Return an entry, or None and enter what is wrong with it by itself."""
    own = {key: value for key, value in written.items() if key in RULE_KEYS}
    try:
        rule = _rule_adapter().validate_json(json.dumps(own), strict=True)
    except ValidationError as error:
        faults += faults_of(document, error.errors(include_url=False), TimelineRule, below=path)
        return None
    own_faults = [document.fault((*path, *inner), text) for inner, text in rule.own_faults()]
    faults += own_faults
    return None if own_faults else rule


@dataclass(slots=True)
class _Placing:
    """One entry among agents, actions and times."""

    rule: TimelineRule
    scenario: Scenario
    action: KnownAction | None
    answers: ActionAnswers
    labels: AgentLabels | None

    def faults(self) -> Iterator[SectionFault]:
        """Yield what is wrong."""
        yield from self._time_faults()
        if self.action is None:
            if self.answers.is_complete:
                words = [each.word for each in self.answers.known]
                hint = did_you_mean(self.rule.action, words)
                yield ("action",), f"no action {self.rule.action!r}{hint}"
            return
        yield from self._action_faults(self.action)
        yield from self._agent_faults(self.action)

    def _time_faults(self) -> Iterator[SectionFault]:
        duration_s = self.scenario.time.duration_s
        for word in ("at_s", "from_s"):
            value = getattr(self.rule, word)
            if value is not None and value >= duration_s:
                text = f"expected less than time.duration_s ({duration_s:g}), got {value:g}"
                yield (word,), f"{text}: the run is over then"
        if self.rule.to_s is not None and self.rule.to_s > duration_s:
            text = f"expected <= time.duration_s ({duration_s:g}), got {self.rule.to_s:g}"
            yield ("to_s",), f"{text}; leave it out for the end of the run"
        if self.rule.when is not None and self.rule.when.for_s >= duration_s:
            text = (
                f"expected less than time.duration_s ({duration_s:g}), got {self.rule.when.for_s:g}"
            )
            yield ("when", "for_s"), f"{text}: it cannot hold for so long"

    def _action_faults(self, action: KnownAction) -> Iterator[SectionFault]:
        mode = self.scenario.time.mode
        if mode not in action.modes:
            text = f"{action.word} is an action of time.mode {' and '.join(action.modes)} alone"
            yield ("action",), f"{text}, got {mode}: leave it out there"
        if action.lasting == "never" and self.rule.for_s is not None:
            yield ("for_s",), f"{action.word} has no end: leave it out"
        if action.word in LOSSES and self.scenario.on_agent_loss == "abort":
            yield ("action",), f"{action.word}: {MUST_CONTINUE}; say on_agent_loss: continue"
        if action.lasting == "must" and self.rule.for_s is None:
            yield ("action",), f"{action.word} needs for_s: how long it lasts, s"

    def _agent_faults(self, action: KnownAction) -> Iterator[SectionFault]:
        given = self.rule.agents
        if not action.takes_agents:
            if given:
                yield ("agents",), f"{action.word} acts on the whole run: leave it out"
            return
        if not given:
            yield ("action",), f'{action.word} needs agents: names, or globs such as ["*"]'
        names = self.scenario.agents.resolved_names()
        if self.labels is None or len(names) != self.scenario.agents.count:
            return  # told already, and what the names mean is open
        for place, pattern in enumerate(given):
            if not self.labels.like(pattern, names):
                yield (
                    ("agents", place),
                    f"no agent is named {pattern}{did_you_mean(pattern, names)}",
                )
        is_drawn = self.rule.rate_per_h is not None  # each agent for itself
        if action.word == PARTITION and not (is_drawn and len(names) > 1):
            parted = self.labels.like_any(given, names)
            if len(parted) == len(names):
                text = f"expected some of the agents, got all {len(names)}: nobody is left on the other side"
                yield ("agents",), text

    def awaited(self, streams: KnownStreams) -> AwaitedCondition | None:
        """Return what it waits for, if it does and agents are known."""
        names = self.scenario.agents.resolved_names()
        if self.rule.when is None or self.labels is None:
            return None
        is_lockstep = self.scenario.time.is_lockstep
        return AwaitedCondition(self.rule.when, streams, names, self.labels, is_lockstep)

    def entry(self, parameters: dict[str, Any]) -> ScheduledEntry:
        """Return what host and agents are told."""
        rule, labels = self.rule, self.labels
        names = self.scenario.agents.resolved_names()
        return ScheduledEntry(
            action=rule.action,
            agents=tuple(labels.like_any(rule.agents, names)) if labels is not None else (),
            parameters=parameters,
            for_s=rule.for_s,
            at_s=rule.at_s,
            every_s=rule.every_s,
            rate_per_h=rule.rate_per_h,
            from_s=rule.from_s or 0.0,
            to_s=rule.to_s,
        )


def _device_faults(
    scenario: Scenario,
    entry: ScheduledEntry,
    patterns: Sequence[str],
    labels: AgentLabels | None,
    streams: KnownStreams,
) -> Iterator[SectionFault]:
    """Yield what does not fit between a device's fault and the devices of its agents."""
    if entry.action != DEVICE_FAULT.word:
        return
    fault, value = str(entry.parameters["fault"]), entry.parameters["value"]
    try:
        check_fault(fault, value)
    except ConfigurationError as error:
        yield ("fault",) if value is None else ("value",), str(error)
    names = scenario.hardware.names
    device = str(entry.parameters["device"])
    if device not in names:
        hint = did_you_mean(device, names) if names else "; there is none under hardware"
        yield ("device",), f"no device {device!r} in this scenario{hint}"
        return
    if fault in ON_NUMBERS and not streams.has_numbers(device):
        yield (
            ("fault",),
            f"{fault} is added to numbers, and {device} measures frames of bytes alone",
        )
    if labels is not None:
        agents = scenario.agents.resolved_names()
        users = labels.like_any(_patterns_of_users(scenario, device), agents)
        for place, pattern in enumerate(patterns):
            if not set(users).intersection(labels.like(pattern, agents)):
                told = named_agents(users) or "no agent"
                text = f"expected an agent that uses device {device} ({told}), got {pattern}"
                yield ("agents", place), text


def _patterns_of_users(scenario: Scenario, device: str) -> list[str]:
    """Return names, labels and globs of the agents that may use a device."""
    hardware = scenario.hardware
    uses = [use.agents for use in hardware.use if device in use.devices]
    own = [each.agents for each in hardware.devices if each.name == device]
    return [pattern for patterns in (*uses, *own) for pattern in patterns]
