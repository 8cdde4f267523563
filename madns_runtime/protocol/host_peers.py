"""
The agents of a run as the host knows them: how far each is, and its link.

Pure book-keeping: proves who speaks, and leaves what is said to the session.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from madns_runtime.config import Timeouts
from madns_runtime.protocol.codec import encode_data, encode_message
from madns_runtime.protocol.counters import REFUSALS
from madns_runtime.protocol.datagram import DATAGRAM_BYTES_MAX, Header, Role, Seal
from madns_runtime.protocol.events import (
    AgentLost,
    AgentMoved,
    HostSessionEvent,
    Phase,
    SyncDeadlineBroken,
)
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import PLUGIN_CHANNEL, LinkSettings
from madns_runtime.protocol.messages import VERSION, WITH_DATA, Message, Pong, Service
from madns_runtime.protocol.silence_limits import Wakefulness, agent_silence_limit_s
from madns_runtime.protocol.states import HOST_LIVE, HostState

Address = tuple[Any, ...]

PINGS_MAX = 16
STRANGERS: Final = ("session", "unknown_agent", "old_incarnation", "behind_forged")
"""
Why a datagram is of no link, beside what links refuse: it is of another run, of nobody, of an earlier process, or came
in one packet behind one that was forged.
"""
INCARNATIONS_MAX = 128
"""Starts of one agent in one run; more are refused."""

_NEVER = float("inf")
_RUNNING = Phase.RUNNING


@dataclass(slots=True, kw_only=True)
class Peer:
    """State of one agent as the host knows it."""

    name: str
    index: int
    phase: Phase = Phase.ABSENT
    link: Link | None = None
    address: Address | None = None
    pid: int | None = None
    """Process that said hello; None until one did."""
    incarnation_ids_seen: set[int] = field(default_factory=set)
    """Random numbers of all processes that spoke for the agent; the link's is the present one."""
    heard_s: float = 0.0
    pings: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=PINGS_MAX))
    """Pings not answered yet: the agent's time, and when it came. Older ones give way: they would tell less of its clock."""
    timer_s: float = float("inf")
    loss_reason: str | None = None
    killed_s: float | None = None
    """When it was last ordered to end without a word; None if it never was."""
    report: Mapping[str, Any] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    records: Mapping[str, Any] = field(default_factory=dict)
    not_sent: int = 0
    """Messages of the host's half that had nobody to go to."""
    retired_counters: list[Mapping[str, Any]] = field(default_factory=list)
    """Counters of the links of earlier incarnations."""
    retired_records: list[Mapping[str, Any]] = field(default_factory=list)
    """Last words of earlier incarnations, as `records`; empty of one that ended without any."""

    @property
    def incarnation(self) -> int:
        """Count of the starts of the agent that have spoken."""
        return len(self.incarnation_ids_seen)


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
        self.awaits_returns = False
        """Whether agents that are lost on purpose are to return: a run without any other goes on."""
        self.are_returns_cut_off = False
        """Whether others were to return when the run is over, by a stop: without any other it lasts until then."""
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

    def await_returns(self, are_due: bool, *, are_cut_off: bool = False) -> None:
        """Note whether agents that are lost on purpose are to return, and whether others were, had no stop come before."""
        self.awaits_returns, self.are_returns_cut_off = are_due, are_cut_off

    @property
    def are_all_lost(self) -> bool:
        """Whether no agent is left, and none is to return, or was before a stop."""
        return not self._has_absent and self.is_empty

    def are_settled(self, phase: Phase) -> bool:
        """Tell whether every agent that is not lost is in *phase*, and one is, or none is to return."""
        return not self.names_outside(phase) and not (self._has_absent and self.is_empty)

    @property
    def _has_absent(self) -> bool:
        return self.awaits_returns or self.are_returns_cut_off

    @property
    def is_empty(self) -> bool:
        """Whether every agent is lost now."""
        return not self.names_outside()

    def move(self, peer: Peer, phase: Phase, reason: str | None = None) -> None:
        """Take note that an agent has reached a phase."""
        if peer.link is not None:
            if phase is Phase.RUNNING:
                self.running[peer.link.peer_prefix] = peer
            else:
                self.running.pop(peer.link.peer_prefix, None)
        peer.phase = phase
        self._events.append(AgentMoved(peer.name, phase, reason, peer.incarnation))

    def lose(self, reasons: Mapping[str, str], *, is_live: bool) -> None:
        """Take note that agents, by name, are lost and why; it is told as a loss while the host *is_live*."""
        for name, reason in reasons.items():
            peer = self.peers[name]
            # One that is being killed is not expelled: by the order that waits for it, it may return.
            peer.loss_reason = reason if peer.killed_s is None else None
            self.move(peer, Phase.LOST, reason)
            if peer.link is not None:
                # What it has not acknowledged is lost, and counted so; a last word may still reach it.
                peer.link.abandon(Service.RELIABLE)
            if is_live:
                self._events.append(AgentLost(name, reason, peer.incarnation))

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
            killed_s = peer.killed_s
            limit_s = agent_silence_limit_s(
                state,
                peer.phase,
                self._timeouts,
                is_over=is_over,
                is_being_killed=killed_s is not None,
            )
            heard_s = max(peer.heard_s, self._wakefulness.blameless_until_s, killed_s or 0.0)
            if now_s - heard_s > limit_s:
                silent[name] = f"silent for {limit_s:g} s while {peer.phase.value}"
        return silent


class HostLinks:
    """
    The links to all agents.

    Args:
        peers: The agents by name.
        wire: The run's secret and the bounds of each link.
        events: Where broken deadlines are told.
    """

    def __init__(
        self, peers: Mapping[str, Peer], wire: LinkSettings, events: deque[HostSessionEvent]
    ) -> None:
        self._by_name = peers
        self._by_index = {peer.index: peer for peer in peers.values()}
        self._wire = wire
        self._events = events
        self._dirty: set[int] = set()
        self._timers: list[tuple[float, int]] = []
        self.refused = dict.fromkeys((*REFUSALS, *STRANGERS), 0)
        """Datagrams that are of no link, by reason; each link counts its own."""
        self._behind: Iterator[bytes] = iter(())

    def mark(self, peer: Peer) -> None:
        """Note that a link was used: it may have something to send, or another timer."""
        self._dirty.add(peer.index)

    def send(self, peer: Peer, message: Message, service: Service, now_s: float) -> None:
        """Queue one of the framework's own few words; nothing without a link."""
        if peer.link is not None:
            peer.link.send_urgent(encode_message(message), service, now_s)
            self._dirty.add(peer.index)

    def send_data(
        self,
        peer: Peer,
        payload: Any,
        service: Service,
        *,
        now_s: float,
        deadline_s: float | None,
    ) -> None:
        """Queue a message of the half's, or one of the framework's that goes with them; nothing without a link."""
        if peer.link is not None:
            self.mark(peer)
            is_message = isinstance(payload, WITH_DATA)
            body = encode_message(payload) if is_message else encode_data(payload)
            peer.link.send(body, service, now_s, channel=PLUGIN_CHANNEL, deadline_s=deadline_s)

    def seal_data(self, agent: str, payload: Any, now_s: float) -> tuple[bytes, Address] | None:
        """
        Return the datagram of a plug-in's BEST message and its address: the quick way of a tick's messages.

        None if it must go through `HostSession.send`.

        Raises:
            UnencodableValue: It holds what messages do not carry.
        """
        peer = self._by_name.get(agent)
        if peer is None or peer.phase is not _RUNNING:
            return None
        link, address = peer.link, peer.address
        if link is None or address is None:
            return None
        datagram = link.seal_best(encode_data(payload), now_s, channel=PLUGIN_CHANNEL)
        return None if datagram is None else (datagram, address)

    def until_forged(self, datagrams: Iterable[bytes]) -> Iterator[bytes]:
        """
        Return the datagrams of one packet, to be handed in one by one: behind a forged one there are no more.

        All are of one process, so that nothing is lost; a packet of forgeries would cost as much as many. Those that
        are left out are counted.
        """
        self._behind = iter(datagrams)
        return self._behind

    def receive(self, data: bytes, address: Address, now_s: float) -> tuple[Peer, Link] | None:
        """
        Take a datagram from anywhere.

        Returns:
            Who sent it and the link that has its messages, which is not the peer's if another process
            speaks: see `replace`. None, and counted, if it is refused.
        """
        header = Header.peek(data)
        fault = self._find_fault(header, len(data))
        if header is None or fault is not None:
            self._refuse_packet(fault or "short")
            return None
        peer = self._by_index[header.agent_index]
        link = peer.link
        if link is None or header.incarnation_id != link.incarnation_id:
            link = self._receive_stranger(peer, header, data, now_s)
        elif not link.receive_datagram(data, now_s):
            if link.was_forged:
                self._drop_behind()
            return None
        if link is None:
            return None
        peer.heard_s = now_s
        peer.address = address
        self._dirty.add(peer.index)
        return peer, link

    def _refuse_packet(self, reason: str) -> None:
        self.refused[reason] += 1
        self._drop_behind()

    def _drop_behind(self) -> None:
        self.refused["behind_forged"] += sum(1 for _ in self._behind)

    def _find_fault(self, header: Header | None, size: int) -> str | None:
        """Return why a datagram can be of no link, None if it can."""
        if header is None:
            return "oversize" if size > DATAGRAM_BYTES_MAX else "short"
        if header.version != VERSION:
            return "version"
        if header.session != self._wire.session:
            return "session"
        return None if header.agent_index in self._by_index else "unknown_agent"

    def _receive_stranger(
        self, peer: Peer, header: Header, data: bytes, now_s: float
    ) -> Link | None:
        """Take the first datagram of an incarnation, which must prove that it holds the run key: its link."""
        seen = peer.incarnation_ids_seen
        is_over = peer.phase in (Phase.COMPLETE, Phase.STOPPED)
        if header.incarnation_id in seen or len(seen) >= INCARNATIONS_MAX or is_over:
            self.refused["old_incarnation"] += 1
            return None
        wire = self._wire
        seal = Seal.derive(wire.run_key, wire.session, peer.index, header.incarnation_id, Role.HOST)
        if (fault := seal.find_fault(data)) is not None:
            self._refuse_packet(fault)
            return None
        # Only for one who has the key: a link takes several times as long to make as a seal.
        link = Link(seal=seal, limits=wire.limits)
        if not link.receive_datagram(data, now_s):
            for reason, count in link.counters.refused.items():
                self.refused[reason] += count
            return None
        return link

    def replace(self, peer: Peer, link: Link) -> None:
        """Give a peer the link of its new incarnation; what it had not acknowledged in the old one is lost."""
        if peer.link is not None:
            peer.link.abandon()
            self._tell_broken(peer, peer.link)
            peer.retired_counters.append(peer.link.counters.to_mapping())
            peer.retired_records.append(peer.records)
            peer.records = {}
        peer.link, peer.killed_s = link, None
        peer.incarnation_ids_seen.add(link.incarnation_id)
        peer.pings.clear()
        peer.timer_s = _NEVER

    def datagrams_to_send(self, now_s: float) -> list[tuple[bytes, Address]]:
        """Return what is to be sent now, and to whom."""
        out: list[tuple[bytes, Address]] = []
        for index in sorted(self._dirty):
            peer = self._by_index[index]
            link, address = peer.link, peer.address
            if link is None or address is None:
                continue
            while peer.pings:
                t_agent_s, t_received_s = peer.pings.popleft()
                self.send(peer, Pong(t_agent_s, t_received_s, now_s), Service.BEST, now_s)
            out.extend((data, address) for data in link.datagrams_to_send(now_s))
            self._tell_broken(peer, link)
            due_s = link.get_timer()
            if due_s is not None and due_s < peer.timer_s:
                peer.timer_s = due_s
                heapq.heappush(self._timers, (due_s, index))
        self._dirty.clear()
        return out

    def _tell_broken(self, peer: Peer, link: Link) -> None:
        while (broken := link.next_broken_deadline()) is not None:
            self._events.append(SyncDeadlineBroken(peer.name, broken))

    def get_timer(self) -> float:
        """Return when `handle_timer` wants to be called, infinity for never."""
        return self._timers[0][0] if self._timers else _NEVER

    def handle_timer(self, now_s: float) -> None:
        """Let every link whose time has come do what is due."""
        while self._timers and self._timers[0][0] <= now_s:
            due_s, index = heapq.heappop(self._timers)
            peer = self._by_index[index]
            if due_s != peer.timer_s:
                continue  # an earlier time was set meanwhile; that entry counts
            peer.timer_s = _NEVER
            if peer.link is not None:
                peer.link.handle_timer(now_s)
                self._dirty.add(index)
