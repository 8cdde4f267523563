"""Streams that a simulation declares: those of all, and those of agents whose parameters are their own. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from madns_runtime.plugin.api import DeclaredStream


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentStreams:
    """All streams that a simulation declares by the parameters of some agents, where these differ."""

    agents: tuple[str, ...]
    streams: tuple[DeclaredStream, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class DeclaredStreams:
    """The whole declaration of a simulation."""

    of_all: tuple[DeclaredStream, ...]
    """By the scenario's parameters: of the host's half, and of agents without parameters of their own."""
    of_agents: tuple[AgentStreams, ...] = ()

    def stream_of(self, role: str, name: str, source: str) -> DeclaredStream | None:
        """Return the declaration of a stream that *source* records; None if there is none."""
        ruled = (each.streams for each in self.of_agents if source in each.agents)
        streams = next(ruled, self.of_all) if role == "agent" else self.every()
        return next((one for one in streams if (one.role, one.name) == (role, name)), None)

    def every(self) -> tuple[DeclaredStream, ...]:
        """Return all declared streams, as `every_stream` does."""
        return every_stream(self.of_all, self.of_agents)


def every_stream(
    of_all: Sequence[DeclaredStream], of_agents: Iterable[AgentStreams]
) -> tuple[DeclaredStream, ...]:
    """Return all declared streams, of each name those of all first, and then others that some agents have instead."""
    found = list(of_all)
    for each in of_agents:
        found += [stream for stream in each.streams if stream not in found]
    return tuple(found)
