"""
The host's side of a run, pure: datagrams and now_s in, datagrams and events out.

Owns one link an agent, the host's state machine, who is ready, running, complete or lost, and every
deadline. The composition root feeds it and carries out what its events say.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from madns_runtime import __version__
from madns_runtime.config import Timeouts
from madns_runtime.protocol.codec import (
    NO_DATA,
    MalformedMessage,
    decode_data,
    decode_message,
    encode_data,
    encode_message,
)
from madns_runtime.protocol.host_events import (
    Address,
    AgentLost,
    AgentMoved,
    AgentRejoined,
    AgentRejoining,
    AgentsComplete,
    AgentsReady,
    AgentsSimulationReady,
    AgentsStopped,
    DataReceived,
    EmergencyDeclared,
    HostSessionEvent,
    Peer,
    Phase,
    StateEntered,
    SyncDeadlineBroken,
)
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.messages import (
    AgentStopped,
    EmergencyShutdown,
    Expelled,
    Hello,
    Message,
    Ping,
    Pong,
    Service,
    SimulationComplete,
    SimulationData,
    SimulationReady,
    SimulationSetup,
    SimulationStart,
    SystemStop,
)
from madns_runtime.protocol.seal import PREFIX_BYTES, Header, peek
from madns_runtime.protocol.states import HOST_LIVE, HostEvent, HostState, host_machine
from madns_runtime.protocol.wire import Wire

CHECK_INTERVAL_S = 0.1
"""How often silence and deadlines are looked at."""
STALL_S = 1.0
"""A host that was not called for this long was itself frozen, and blames no agent for silence."""
LINGER_S = 0.5
"""How long the host waits at the end for its last acknowledgements to leave."""
INCARNATIONS_MAX = 128
"""Starts of one agent in one run; more are refused."""
PLUGIN_CHANNEL = 1


class HostSession:
    """
    The host's conversation with all agents.

    Args:
        agents: Names, in order; an agent's index on the wire is its place, from 1.
        wire: The run's secret and the bounds of each link.
        timeouts: The run's deadlines.
        on_agent_loss: abort or continue.
        now_s: Present time of the host's monotonic clock.
    """

    def __init__(
        self,
        agents: Sequence[str],
        wire: Wire,
        *,
        timeouts: Timeouts,
        on_agent_loss: Literal["abort", "continue"],
        now_s: float,
    ) -> None:
        self.peers = {name: Peer(name=name, index=i) for i, name in enumerate(agents, start=1)}
        self._by_index = {peer.index: peer for peer in self.peers.values()}
        self._running: dict[bytes, Peer] = {}  # by their links' prefix
        self._wire = wire
        self._timeouts = timeouts
        self._aborts = on_agent_loss == "abort"
        self._machine = host_machine()
        self._events: deque[HostSessionEvent] = deque()
        self._dirty: set[int] = set()
        self._timers: list[tuple[float, int]] = []
        self._state_deadline_s = now_s + timeouts.agents_ready_s
        self._entered_s = now_s
        self._check_due_s = now_s
        self._handled_s = now_s
        self._t0_host_s: float | None = None
        self._end_host_s = float("inf")
        self.refused: dict[str, int] = {"not_ours": 0, "unknown_agent": 0, "old_incarnation": 0}
        self.malformed_count = 0

    @property
    def state(self) -> HostState:
        """Where the host stands."""
        return self._machine.state

    def agents_in(self, *phases: Phase) -> tuple[str, ...]:
        """Return the names of agents in any of *phases*."""
        return tuple(name for name, peer in self.peers.items() if peer.phase in phases)

    # What the composition root reports ------------------------------------------------------

    def setup_finished(self, initial: Mapping[str, Any], now_s: float) -> None:
        """Send each agent its initial data (by name); their readiness is awaited."""
        self._fire(HostEvent.SETUP_FINISHED)
        self._enter(now_s, self._timeouts.agent_setup_s)
        for name, data in initial.items():
            if self.peers[name].phase is Phase.READY:
                self.send_setup(name, data, now_s)
        self._progress(now_s)

    def send_setup(self, agent: str, initial: Any, now_s: float) -> None:
        """Send one agent its initial data: after `AgentRejoining`."""
        peer = self.peers[agent]
        if peer.phase is Phase.READY:
            self._send(peer, SimulationSetup(initial), Service.RELIABLE, now_s)
            self._set_phase(peer, Phase.SETTING_UP)

    def start(self, t0_host_s: float, duration_s: float, now_s: float) -> None:
        """Tell every agent that simulated time zero is *t0_host_s* on the host's monotonic clock."""
        self._fire(HostEvent.AGENTS_SIMULATION_READY)
        self._t0_host_s = t0_host_s
        self._end_host_s = t0_host_s + duration_s
        self._enter(now_s, t0_host_s - now_s + duration_s + self._timeouts.complete_s)
        for peer in self.peers.values():
            if peer.phase is Phase.SIMULATION_READY:
                self._start_peer(peer, now_s)
        self._progress(now_s)

    def order_stop(self, now_s: float) -> None:
        """Tell every agent to flush its records and end."""
        self._fire(HostEvent.STOP_ORDERED)
        self._enter(now_s, self._timeouts.shutdown_s)
        for peer in self.peers.values():
            if peer.phase is Phase.COMPLETE:
                # Behind whatever the host's half has sent: RELIABLE, so that it overtakes nothing.
                self._send(peer, SystemStop(), Service.RELIABLE, now_s)
        self._progress(now_s)

    def emergency(self, who: str, reason: str, now_s: float) -> None:
        """Declare an emergency and tell every agent; no effect when already ending."""
        if not self._machine.allows(HostEvent.EMERGENCY):
            return
        self._fire(HostEvent.EMERGENCY)
        self._enter(now_s, self._timeouts.shutdown_s)
        self._events.append(EmergencyDeclared(who, reason))
        for peer in self.peers.values():
            if peer.link is not None and peer.phase is not Phase.STOPPED:
                self._send(peer, EmergencyShutdown(who, reason), Service.SYNC, now_s)
        self._progress(now_s)

    def agent_exited(self, agent: str, how: str, now_s: float, *, pid: int | None = None) -> None:
        """
        Take the operator's word that an agent's process is gone, without waiting for silence.

        Word of another *pid* than the one that said hello is about an earlier incarnation.
        """
        peer = self.peers.get(agent)
        if peer is None or peer.phase in (Phase.LOST, Phase.STOPPED):
            return
        if pid is None or peer.pid is None or pid == peer.pid:
            self._lose(peer, how, now_s)

    def cleaned_up(self) -> None:
        """Simulation and executor are closed."""
        self._fire(HostEvent.CLEANED_UP)

    def records_closed(self, now_s: float) -> None:
        """The host's records are on disk; the session lingers for its last acknowledgements."""
        self._fire(HostEvent.RECORDS_CLOSED)
        self._enter(now_s, LINGER_S)

    def send(
        self,
        agent: str,
        payload: Any,
        service: Service,
        now_s: float,
        *,
        deadline_s: float | None = None,
    ) -> bool:
        """
        Send a plug-in's message; False if that agent is lost or not there yet.

        Raises:
            MessageTooLarge: It does not fit its class of service.
            SendQueueFull: The agent has not taken what was sent before.
        """
        peer = self.peers[agent]
        if peer.link is None or peer.phase in (Phase.LOST, Phase.STOPPED):
            peer.not_sent += 1
            return False
        body = encode_data(payload)
        peer.link.send(body, service, now_s, channel=PLUGIN_CHANNEL, deadline_s=deadline_s)
        self._dirty.add(peer.index)
        return True

    # The quick way of a tick's messages ---------------------------------------------------------

    def seal_data(self, agent: str, payload: Any, now_s: float) -> tuple[bytes, Address] | None:
        """
        Return the datagram of a plug-in's BEST message and its address; None if it must go through `send`.

        Raises:
            UnencodableValue: It holds what messages do not carry.
        """
        peer = self.peers.get(agent)
        if peer is None or peer.phase is not Phase.RUNNING:
            return None
        link, address = peer.link, peer.address
        if link is None or address is None:
            return None
        datagram = link.seal_best(encode_data(payload), now_s, channel=PLUGIN_CHANNEL)
        return None if datagram is None else (datagram, address)

    def receive_data(self, data: bytes, address: Address, now_s: float) -> tuple[str, Any] | None:
        """
        Take one datagram, as `receive_datagram` does, but return the message of one like most.

        Returns:
            Agent and payload, if all that it brought is one BEST message of a running agent's half;
            else None, and events say what it brought.
        """
        peer = self._running.get(data[:PREFIX_BYTES])
        link = None if peer is None or self._events else peer.link
        body = None if link is None else link.open_best(data, now_s)
        if peer is None or body is None:
            self.receive_datagram(data, address, now_s)
            return None
        peer.heard_s = now_s
        peer.address = address
        payload = decode_data(body)
        if payload is NO_DATA:
            self._dirty.add(peer.index)
            self._take(peer, body, now_s)
            return None
        return peer.name, payload

    # Datagrams and time ------------------------------------------------------------------------

    def receive_datagram(self, data: bytes, address: Address, now_s: float) -> None:
        """Take one datagram from anywhere; whatever is wrong with it is counted."""
        header = peek(data)
        if header is None or header.session != self._wire.session:
            self.refused["not_ours"] += 1
            return
        peer = self._by_index.get(header.agent_index)
        if peer is None:
            self.refused["unknown_agent"] += 1
            return
        link = peer.link
        if link is None or header.incarnation != peer.incarnation:
            self._receive_stranger(peer, header, data, address, now_s)
            return
        if not link.receive_datagram(data, now_s):
            self._dirty.add(peer.index)
            return
        peer.heard_s = now_s
        peer.address = address
        self._dirty.add(peer.index)
        self._take_messages(peer, now_s)

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
                self._send(peer, Pong(t_agent_s, t_received_s, now_s), Service.BEST, now_s)
            out.extend((data, address) for data in link.datagrams_to_send(now_s))
            while (broken := link.next_broken_deadline()) is not None:
                self._events.append(SyncDeadlineBroken(peer.name, broken))
            due_s = link.get_timer()
            if due_s is not None and due_s < peer.timer_s:
                peer.timer_s = due_s
                heapq.heappush(self._timers, (due_s, index))
        self._dirty.clear()
        return out

    def get_timer(self) -> float | None:
        """Return when `handle_timer` wants to be called, at the latest."""
        if self.state is HostState.EXIT:
            return None
        return min(self._check_due_s, self._timers[0][0]) if self._timers else self._check_due_s

    def handle_timer(self, now_s: float) -> None:
        """Do what is due. Received datagrams must have been handed in before."""
        while self._timers and self._timers[0][0] <= now_s:
            due_s, index = heapq.heappop(self._timers)
            peer = self._by_index[index]
            if due_s != peer.timer_s:
                continue  # an earlier time was set meanwhile; that entry counts
            peer.timer_s = float("inf")
            if peer.link is not None:
                peer.link.handle_timer(now_s)
                self._dirty.add(index)
        if now_s >= self._check_due_s:
            self._check_due_s = now_s + CHECK_INTERVAL_S
            self._excuse_own_stall(now_s)
            self._check_silence(now_s)
            self._check_state_deadline(now_s)

    def next_event(self) -> HostSessionEvent | None:
        """Return the oldest event not yet taken."""
        return self._events.popleft() if self._events else None

    # Inside: one agent -----------------------------------------------------------------------------

    def _send(self, peer: Peer, message: Message, service: Service, now_s: float) -> None:
        if peer.link is not None:
            peer.link.send_urgent(encode_message(message), service, now_s)
            self._dirty.add(peer.index)

    def _set_phase(self, peer: Peer, phase: Phase, reason: str | None = None) -> None:
        if peer.link is not None:
            if phase is Phase.RUNNING:
                self._running[peer.link.peer_prefix] = peer
            else:
                self._running.pop(peer.link.peer_prefix, None)
        peer.phase = phase
        self._events.append(AgentMoved(peer.name, phase, reason))

    def _receive_stranger(
        self, peer: Peer, header: Header, data: bytes, address: Address, now_s: float
    ) -> None:
        """Take the first datagram of an incarnation; it must prove that it holds the run key."""
        seen = peer.incarnations_seen
        is_over = peer.phase in (Phase.COMPLETE, Phase.STOPPED)
        if header.incarnation in seen or len(seen) >= INCARNATIONS_MAX or is_over:
            self.refused["old_incarnation"] += 1
            return
        wire = self._wire
        link = Link.for_host(
            wire.run_key, wire.session, peer.index, header.incarnation, limits=wire.limits
        )
        if not link.receive_datagram(data, now_s):
            self.refused["not_ours"] += 1
            return
        if peer.link is not None and peer.phase not in (Phase.LOST, Phase.STOPPED):
            self._lose(peer, "another process took its place", now_s)
        if peer.link is not None:
            peer.retired_counters.append(peer.link.counters.to_mapping())
        seen.add(header.incarnation)
        peer.link, peer.address, peer.incarnation = link, address, header.incarnation
        peer.timer_s = float("inf")
        peer.heard_s = now_s
        peer.pid, peer.loss_reason = None, None
        peer.pings.clear()
        if peer.phase is not Phase.ABSENT:
            # Its hello may come behind a ping, if the first datagram was lost.
            self._set_phase(peer, Phase.JOINING)
        self._dirty.add(peer.index)
        self._take_messages(peer, now_s)

    def _take_messages(self, peer: Peer, now_s: float) -> None:
        link = peer.link
        while link is not None and (received := link.next_message()) is not None:
            self._take(peer, received.body, now_s)

    def _take(self, peer: Peer, body: bytes, now_s: float) -> None:
        try:
            message = decode_message(body)
        except MalformedMessage:
            self.malformed_count += 1
        else:
            self._receive(peer, message, now_s)

    def _receive(self, peer: Peer, message: Message, now_s: float) -> None:
        if isinstance(message, EmergencyShutdown):
            self._record_agent_emergency(peer, message, now_s)
        elif isinstance(message, AgentStopped):
            self._agent_stopped(peer, message, now_s)
        elif isinstance(message, Hello):
            self._welcome(peer, message, now_s)
        elif peer.phase is Phase.LOST:
            self._send_expelled(peer, now_s)
        elif isinstance(message, SimulationData):
            self._events.append(DataReceived(peer.name, message.payload))
        elif isinstance(message, Ping):
            peer.report = message.report
            peer.pings.append((message.t_agent_s, now_s))
            self._dirty.add(peer.index)
        elif isinstance(message, SimulationReady):
            self._agent_simulation_ready(peer, now_s)
        elif isinstance(message, SimulationComplete):
            peer.summary = message.summary
            self._set_phase(peer, Phase.COMPLETE)
            self._progress(now_s)
        else:
            self.malformed_count += 1  # a message that only hosts send

    def _welcome(self, peer: Peer, hello: Hello, now_s: float) -> None:
        state = self.state
        peer.pid = hello.pid
        if hello.runtime_version != __version__ or hello.agent != peer.name:
            reason = f"{hello.agent} runs MADNS {hello.runtime_version}, the host {__version__}"
            self._lose(peer, reason, now_s)
            self._send_expelled(peer, now_s)
            return
        if state in (HostState.HOST_STARTUP, HostState.SIMULATION_SETUP):
            self._set_phase(peer, Phase.READY)
            self._progress(now_s)
        elif state in (HostState.HOST_SIMULATION_READY, HostState.SIMULATION_START):
            peer.rejoining = True
            self._set_phase(peer, Phase.READY)
            self._events.append(AgentRejoining(peer.name))
        elif peer.phase not in (Phase.COMPLETE, Phase.STOPPED):
            reason = "the run is already ending"
            self._send(peer, EmergencyShutdown("host", reason), Service.SYNC, now_s)

    def _agent_simulation_ready(self, peer: Peer, now_s: float) -> None:
        if self.state is HostState.SIMULATION_START:
            self._start_peer(peer, now_s)
            peer.rejoining = False
            peer.loss_reason = None
            self._events.append(AgentRejoined(peer.name))
        else:
            self._set_phase(peer, Phase.SIMULATION_READY)
            self._progress(now_s)

    def _start_peer(self, peer: Peer, now_s: float) -> None:
        if self._t0_host_s is not None:
            self._send(peer, SimulationStart(self._t0_host_s), Service.SYNC, now_s)
            self._set_phase(peer, Phase.RUNNING)

    def _agent_stopped(self, peer: Peer, message: AgentStopped, now_s: float) -> None:
        peer.records = message.records
        if self.state in _BEFORE_STOP and peer.phase is not Phase.LOST:
            self._lose(peer, "it stopped before it was told to", now_s)
        elif peer.phase is not Phase.LOST:
            self._set_phase(peer, Phase.STOPPED)
        self._progress(now_s)

    def _record_agent_emergency(self, peer: Peer, message: EmergencyShutdown, now_s: float) -> None:
        """An agent ends itself: that loses one member, and under abort the run."""
        if peer.phase not in (Phase.LOST, Phase.STOPPED):
            self._lose(peer, message.reason, now_s)

    def _send_expelled(self, peer: Peer, now_s: float) -> None:
        if peer.loss_reason is not None and self.state in HOST_LIVE:
            self._send(peer, Expelled(peer.loss_reason), Service.SYNC, now_s)
            peer.loss_reason = None  # said once an incarnation

    def _lose(self, peer: Peer, reason: str, now_s: float) -> None:
        peer.loss_reason = reason
        peer.rejoining = False
        self._set_phase(peer, Phase.LOST, reason)
        if peer.link is not None:
            # What it has not acknowledged is lost, and counted so; a last word may still reach it.
            peer.link.abandon(Service.RELIABLE)
        if self.state not in HOST_LIVE:
            self._progress(now_s)
            return
        self._events.append(AgentLost(peer.name, reason))
        if self._aborts or all(p.phase is Phase.LOST for p in self.peers.values()):
            self.emergency(peer.name, reason, now_s)
        else:
            self._progress(now_s)

    # Inside: all agents ---------------------------------------------------------------------------

    def _fire(self, event: HostEvent) -> None:
        self._events.append(StateEntered(self._machine.fire(event)))

    def _enter(self, now_s: float, deadline_s: float) -> None:
        self._entered_s = now_s
        self._state_deadline_s = now_s + deadline_s

    def _all_in(self, *phases: Phase) -> bool:
        return all(p.phase in phases or p.phase is Phase.LOST for p in self.peers.values())

    def _progress(self, now_s: float) -> None:
        """Move on when nobody is waited for any more."""
        state = self.state
        if state is HostState.HOST_STARTUP and self._all_in(Phase.READY):
            self._fire(HostEvent.AGENTS_READY)
            self._enter(now_s, self._timeouts.host_setup_s)
            self._events.append(AgentsReady())
        elif state is HostState.HOST_SIMULATION_READY and self._all_in(Phase.SIMULATION_READY):
            self._events.append(AgentsSimulationReady())
        elif state is HostState.SIMULATION_START and self._all_in(Phase.COMPLETE):
            self._fire(HostEvent.AGENTS_COMPLETE)
            self._enter(now_s, self._timeouts.shutdown_s)
            self._events.append(AgentsComplete())
        elif state in (HostState.BEGIN_SHUTDOWN, HostState.EMERGENCY_SHUTDOWN) and self._all_in(
            Phase.STOPPED, Phase.ABSENT
        ):
            self._stop(now_s, ())

    def _stop(self, now_s: float, missing: tuple[str, ...]) -> None:
        self._fire(HostEvent.AGENTS_STOPPED)
        self._enter(now_s, self._timeouts.shutdown_s)
        self._events.append(AgentsStopped(missing))

    def _excuse_own_stall(self, now_s: float) -> None:
        if now_s - self._handled_s > STALL_S:
            heard_s = now_s - self._timeouts.silence_s / 2
            for peer in self.peers.values():
                peer.heard_s = max(peer.heard_s, heard_s)
        self._handled_s = now_s

    def _check_silence(self, now_s: float) -> None:
        if self.state not in HOST_LIVE:
            return
        for peer in self.peers.values():
            limit_s = self._silence_limit_s(peer, now_s)
            if now_s - peer.heard_s > limit_s:
                self._lose(peer, f"silent for {limit_s:g} s while {peer.phase.value}", now_s)

    def _silence_limit_s(self, peer: Peer, now_s: float) -> float:
        """Return how long *peer* may say nothing: longer where its plug-in or its disk keeps it busy."""
        state, phase = self.state, peer.phase
        if phase in (Phase.ABSENT, Phase.STOPPED, Phase.LOST) or state is HostState.BEGIN_SHUTDOWN:
            return float("inf")  # nobody to hear, or a state whose own deadline waits for all
        limit_s = self._timeouts.silence_s
        if state is HostState.HOST_SIMULATION_READY or phase is Phase.SETTING_UP:
            # Its half is being set up, or that of an agent which shares its process.
            return limit_s + self._timeouts.agent_setup_s
        if now_s > self._end_host_s:
            return limit_s + self._timeouts.complete_s  # its half makes its summary
        return limit_s

    def _check_state_deadline(self, now_s: float) -> None:
        if now_s < self._state_deadline_s:
            return
        state = self.state
        waited_s = round(now_s - self._entered_s, 1)
        if state is HostState.HOST_STARTUP:
            self._lose_all("AGENT_READY", waited_s, Phase.ABSENT, Phase.JOINING, now_s=now_s)
        elif state is HostState.SIMULATION_SETUP:
            self.emergency(
                "host", f"setup of the simulation took longer than {waited_s:g} s", now_s
            )
        elif state is HostState.HOST_SIMULATION_READY:
            self._lose_all(
                "AGENT_SIMULATION_READY",
                waited_s,
                Phase.JOINING,
                Phase.READY,
                Phase.SETTING_UP,
                now_s=now_s,
            )
        elif state is HostState.SIMULATION_START:
            self._lose_all("SIMULATION_COMPLETE", waited_s, *_UNFINISHED, now_s=now_s)
        elif state in (HostState.BEGIN_SHUTDOWN, HostState.EMERGENCY_SHUTDOWN):
            self._stop(now_s, self._not_stopped())
        elif state is HostState.WAITING_SERVER_STOP:
            self._fire(HostEvent.SERVER_STOPPED)

    def _not_stopped(self) -> tuple[str, ...]:
        settled = (Phase.STOPPED, Phase.LOST, Phase.ABSENT)
        return tuple(n for n, p in self.peers.items() if p.phase not in settled)

    def _lose_all(self, what: str, waited_s: float, *phases: Phase, now_s: float) -> None:
        """End a wait: whoever did not answer is lost, all of them named at once."""
        missing = self.agents_in(*phases)
        self._state_deadline_s = now_s + self._timeouts.silence_s
        if not missing:
            return
        reason = f"no {what} in {waited_s:g} s"
        if self._aborts:
            for name in missing:
                self._set_phase(self.peers[name], Phase.LOST, reason)
                self._events.append(AgentLost(name, reason))
            self.emergency(", ".join(missing), reason, now_s)
            return
        for name in missing:
            self._lose(self.peers[name], reason, now_s)


_BEFORE_STOP = tuple(state for state in HOST_LIVE if state is not HostState.BEGIN_SHUTDOWN)
_UNFINISHED = (Phase.JOINING, Phase.READY, Phase.SETTING_UP, Phase.SIMULATION_READY, Phase.RUNNING)
