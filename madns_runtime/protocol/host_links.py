"""
A host's links, one an agent: which datagram is whose, who has something to send, whose timer is next.

Proves who speaks, and leaves what is said to the session.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Mapping
from typing import Any

from madns_runtime.protocol.codec import encode_data, encode_message
from madns_runtime.protocol.host_events import (
    Address,
    HostSessionEvent,
    Peer,
    Phase,
    SyncDeadlineBroken,
)
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.messages import Message, Pong, Service
from madns_runtime.protocol.seal import Header, peek
from madns_runtime.protocol.wire import PLUGIN_CHANNEL, Wire

INCARNATIONS_MAX = 128
"""Starts of one agent in one run; more are refused."""

_NEVER = float("inf")
_RUNNING = Phase.RUNNING


class HostLinks:
    """
    The links to all agents.

    Args:
        peers: The agents by name.
        wire: The run's secret and the bounds of each link.
        events: Where broken deadlines are told.
    """

    def __init__(
        self, peers: Mapping[str, Peer], wire: Wire, events: deque[HostSessionEvent]
    ) -> None:
        self._by_name = peers
        self._by_index = {peer.index: peer for peer in peers.values()}
        self._wire = wire
        self._events = events
        self._dirty: set[int] = set()
        self._timers: list[tuple[float, int]] = []
        self.refused = {"not_ours": 0, "unknown_agent": 0, "old_incarnation": 0}
        """Datagrams that are of no link, by reason; each link counts its own."""

    def mark(self, peer: Peer) -> None:
        """Note that a link was used: it may have something to send, or another timer."""
        self._dirty.add(peer.index)

    def send(self, peer: Peer, message: Message, service: Service, now_s: float) -> None:
        """Queue one of the framework's own few words; nothing without a link."""
        if peer.link is not None:
            peer.link.send_urgent(encode_message(message), service, now_s)
            self._dirty.add(peer.index)

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

    def receive(self, data: bytes, address: Address, now_s: float) -> tuple[Peer, Link] | None:
        """
        Take a datagram from anywhere.

        Returns:
            Who sent it and the link that has its messages, which is not the peer's if another process
            speaks: see `replace`. None, and counted, if it is refused.
        """
        header = peek(data)
        if header is None or header.session != self._wire.session:
            self.refused["not_ours"] += 1
            return None
        peer = self._by_index.get(header.agent_index)
        if peer is None:
            self.refused["unknown_agent"] += 1
            return None
        link = peer.link
        if link is None or header.incarnation != link.incarnation:
            link = self._receive_stranger(peer, header, data, now_s)
        elif not link.receive_datagram(data, now_s):
            return None
        if link is None:
            return None
        peer.heard_s = now_s
        peer.address = address
        self._dirty.add(peer.index)
        return peer, link

    def _receive_stranger(
        self, peer: Peer, header: Header, data: bytes, now_s: float
    ) -> Link | None:
        """Take the first datagram of an incarnation, which must prove that it holds the run key: its link."""
        seen = peer.incarnations_seen
        is_over = peer.phase in (Phase.COMPLETE, Phase.STOPPED)
        if header.incarnation in seen or len(seen) >= INCARNATIONS_MAX or is_over:
            self.refused["old_incarnation"] += 1
            return None
        wire = self._wire
        link = Link.for_host(
            wire.run_key, wire.session, peer.index, header.incarnation, limits=wire.limits
        )
        if not link.receive_datagram(data, now_s):
            self.refused["not_ours"] += 1
            return None
        return link

    def replace(self, peer: Peer, link: Link) -> None:
        """Give a peer the link of its new incarnation; what it had not acknowledged in the old one is lost."""
        if peer.link is not None:
            peer.link.abandon()
            self._tell_broken(peer, peer.link)
            peer.retired_counters.append(peer.link.counters.to_mapping())
        peer.link = link
        peer.incarnations_seen.add(link.incarnation)
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
