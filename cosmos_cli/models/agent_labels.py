"""Second names of agents, such as their satellites', as a simulation's `labels` gives them. Pure."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

LABEL = "label"


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentLabels:
    """A second name per agent, by which whoever selects agents finds them, too."""

    column: str = LABEL
    """Kind of such a name, and the column of tables that bears it, such as satellite."""
    names: Mapping[str, str] = field(default_factory=dict)
    """By agent; some may have none."""

    def named(self, agent: str) -> str:
        """Return an agent's name with the second one behind it, such as `agent-03 (IRIDIUM 8)`."""
        label = self.names.get(agent)
        return f"{agent} ({label})" if label else agent

    def like(self, pattern: str, agents: Sequence[str]) -> list[str]:
        """Return those of *agents* whose name or label is *pattern*, or fits it as a glob; case counts."""
        called = {agent for agent in agents if pattern in (agent, self.names.get(agent))}
        if any(character in pattern for character in "*?["):  # a label may hold them: IRIDIUM 8 [-]
            fits = re.compile(fnmatch.translate(pattern)).match
            both = ((agent, self.names.get(agent, agent)) for agent in agents)
            called |= {agent for agent, label in both if fits(agent) or fits(label)}
        return [agent for agent in agents if agent in called]

    def labelled(self, patterns: Iterable[str]) -> list[str]:
        """Return the agents whose label is, or fits as a glob, one of *patterns*."""
        return self.like_any(patterns, tuple(self.names))

    def like_any(self, patterns: Iterable[str], agents: Sequence[str]) -> list[str]:
        """Return those of *agents* that one of *patterns* finds, in the agents' order."""
        found = {agent for pattern in patterns for agent in self.like(pattern, agents)}
        return [agent for agent in agents if agent in found]


NO_LABELS = AgentLabels()
