"""Rules that say which agents belong on which machines: the part that needs no inventory. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Annotated

from annotated_types import Ge, MinLen

from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.models.document import did_you_mean, may_guess
from cosmos_cli.models.text_forms import DeviceName, NonBlank
from madns_runtime.plain_values import FORBID_EXTRA

RuleFault = tuple[tuple[str | int, ...], str]
"""The path within the list of rules, and what is wrong there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacementRule:
    """Some of the agents, and the machines that they run on."""

    __pydantic_config__ = FORBID_EXTRA

    agents: Annotated[tuple[NonBlank, ...], MinLen(1)] | None = None
    """Names of agents, or globs such as sat-0*; without them and `count`, all that are left."""
    count: Annotated[int, Ge(1)] | None = None
    """Number of agents, instead of names: the next ones that no earlier rule has taken."""
    machines: NonBlank | None = None
    """Machines, as --limit names them: a group, a glob, tower:!chiefs; all if not given."""
    devices: tuple[DeviceName, ...] = ()
    """Devices that the machine must have (cosmos_devices in the inventory)."""
    per_machine: Annotated[int, Ge(1)] | None = None
    """Most agents of this rule on one machine."""

    @property
    def takes_the_rest(self) -> bool:
        """Whether it takes all agents that are left."""
        return not self.agents and self.count is None


@dataclass(frozen=True, slots=True)
class RuledAgents:
    """The agents of each rule, and those that none has taken."""

    taken: tuple[tuple[str, ...], ...]
    """For each rule, in order."""
    left: tuple[str, ...]
    faults: tuple[RuleFault, ...]


def claim_agents(
    names: Sequence[str], rules: Sequence[PlacementRule], labels: AgentLabels = NO_LABELS
) -> RuledAgents:
    """
    Let each rule in turn take its agents from those that are not taken yet.

    Args:
        names: Of all agents, in order.
        rules: In order.
        labels: Second names, by which a rule finds agents, too.
    """
    claiming = _Claiming(names, labels)
    taken = tuple(claiming.take(index, rule) for index, rule in enumerate(rules))
    return RuledAgents(taken, tuple(claiming.left), tuple(claiming.faults))


@dataclass(slots=True)
class _Claiming:
    names: Sequence[str]
    labels: AgentLabels
    owners: dict[str, int] = field(default_factory=dict)
    """Rule that has taken an agent, by agent."""
    free: dict[str, None] = field(init=False)
    """Those that none has taken, in order."""
    known: frozenset[str] = field(init=False)
    by_label: dict[str, list[str]] = field(default_factory=dict)
    rest_taken_by: int | None = None
    faults: list[RuleFault] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.free = dict.fromkeys(self.names)
        self.known = frozenset(self.names)
        for name, label in self.labels.names.items():
            self.by_label.setdefault(label, []).append(name)

    @property
    def left(self) -> list[str]:
        return list(self.free)

    def take(self, index: int, rule: PlacementRule) -> tuple[str, ...]:
        before = len(self.owners)
        if rule.agents and rule.count is not None:
            text = "expected agents or count, got both: agents names them all"
            self.faults.append(((index, "count"), text))
        if rule.agents:
            for place, pattern in enumerate(rule.agents):
                self._take_named(index, place, pattern)
        elif rule.count is not None:
            self._take_next(index, rule.count)
        else:
            if self.rest_taken_by is not None:
                text = f"placement[{self.rest_taken_by}] takes all agents that are left: none is left here"
                self.faults.append(((index,), text))
            self.rest_taken_by = index
            self._own(index, self.left)
        return tuple(self.owners)[before:]

    def _take_next(self, index: int, count: int) -> None:
        if count > len(self.free):
            text = (
                f"expected <= {len(self.free)}, the agents that no earlier rule takes, got {count}"
            )
            self.faults.append(((index, "count"), text))
        self._own(index, list(islice(self.free, count)))

    def _take_named(self, index: int, place: int, pattern: str) -> None:
        is_glob = any(character in pattern for character in "*?[")
        # Looked up: thousands may be named one by one.
        named = [pattern] if pattern in self.known else self.by_label.get(pattern, [])
        fitting = self.labels.like(pattern, self.names) if is_glob else named
        free = [name for name in fitting if name not in self.owners]
        path = (index, "agents", place)
        if not fitting:
            has_hint = may_guess(len(self.faults), len(self.names))
            known = did_you_mean(pattern, (*self.names, *self.by_label)) if has_hint else ""
            hint = known if known.endswith("?") else f"; there are {_ends(self.names)}"
            text = f"no agent is {'like' if is_glob else 'named'} {pattern}{hint}"
            self.faults.append((path, text))
        elif not free:
            first = self.owners[fitting[0]]
            where = "above in this rule" if first == index else f"by placement[{first}]"
            self.faults.append((path, f"expected each agent once, {pattern} is taken {where}"))
        self._own(index, free)

    def _own(self, index: int, names: Sequence[str]) -> None:
        self.owners.update(dict.fromkeys(names, index))
        for name in names:
            self.free.pop(name, None)


def _ends(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{names[0]}, {names[1]}, ... {names[-1]}"
