"""Who takes part in a run, and how far each agent has come; pure book-keeping, told to the session's owner."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

from madns_runtime.config import Timeouts
from madns_runtime.protocol.host_events import (
    AgentLost,
    AgentMoved,
    HostSessionEvent,
    Peer,
    Phase,
)
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.silence import Wakefulness, agent_silence_limit_s
from madns_runtime.protocol.states import HOST_LIVE, HostState


class Roster:
    """
    The agents of a run.

    Args:
        agents: Names, in order; an agent's index on the wire is its place, from 1.
        timeouts: The run's deadlines.
        events: Where it is told what becomes of them.
        now_s: Present time of the host's monotonic clock.
    """

    def __init__(
        self,
        agents: Sequence[str],
        timeouts: Timeouts,
        *,
        events: deque[HostSessionEvent],
        now_s: float,
    ) -> None:
        self.peers = {name: Peer(name=name, index=i) for i, name in enumerate(agents, start=1)}
        self.running: dict[bytes, Peer] = {}
        """Running agents by the prefix of their datagrams."""
        self._timeouts = timeouts
        self._events = events
        self._wakefulness = Wakefulness(timeouts.silence_s, now_s)

    def names_in(self, *phases: Phase) -> tuple[str, ...]:
        """Return the names of agents in any of *phases*."""
        return tuple(name for name, peer in self.peers.items() if peer.phase in phases)

    def names_outside(self, *phases: Phase) -> tuple[str, ...]:
        """Return the names of agents that are neither lost nor in any of *phases*."""
        settled = (*phases, Phase.LOST)
        return tuple(name for name, peer in self.peers.items() if peer.phase not in settled)

    def move(self, peer: Peer, phase: Phase, reason: str | None = None) -> None:
        """Take note that an agent has reached a phase."""
        if peer.link is not None:
            if phase is Phase.RUNNING:
                self.running[peer.link.peer_prefix] = peer
            else:
                self.running.pop(peer.link.peer_prefix, None)
        peer.phase = phase
        self._events.append(AgentMoved(peer.name, phase, reason))

    def lose(self, reasons: Mapping[str, str], *, is_live: bool) -> None:
        """Take note that agents, by name, are lost and why; it is told as a loss while the host *is_live*."""
        for name, reason in reasons.items():
            peer = self.peers[name]
            peer.loss_reason = reason
            self.move(peer, Phase.LOST, reason)
            if peer.link is not None:
                # What it has not acknowledged is lost, and counted so; a last word may still reach it.
                peer.link.abandon(Service.RELIABLE)
            if is_live:
                self._events.append(AgentLost(name, reason))

    def find_silent(self, state: HostState, now_s: float, *, is_over: bool) -> dict[str, str]:
        """
        Return whom nothing was heard of for too long, and for how long; called at least every second.

        Args:
            state: The host's.
            now_s: Present time.
            is_over: Whether the simulated time is.
        """
        self._wakefulness.called(now_s)
        silent: dict[str, str] = {}
        if state not in HOST_LIVE:
            return silent
        for name, peer in self.peers.items():
            limit_s = agent_silence_limit_s(state, peer.phase, self._timeouts, is_over=is_over)
            if now_s - max(peer.heard_s, self._wakefulness.blameless_until_s) > limit_s:
                silent[name] = f"silent for {limit_s:g} s while {peer.phase.value}"
        return silent
