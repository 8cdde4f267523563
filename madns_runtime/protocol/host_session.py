"""
The host's side of a run, pure: datagrams and now_s in, datagrams and events out.

Owns a link per agent, the state machine, the roster and every deadline; its owner carries its events out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, Literal

from madns_runtime import __version__
from madns_runtime.config import Timeouts
from madns_runtime.protocol import accounts, events, messages
from madns_runtime.protocol.codec import NO_DATA, MalformedMessage, decode_data, decode_message
from madns_runtime.protocol.datagram import PREFIX_BYTES
from madns_runtime.protocol.events import HostSessionEvent, Phase
from madns_runtime.protocol.host_peers import Address, HostLinks, Peer, Roster
from madns_runtime.protocol.host_waits import AWAITED, ENDING, StateWait
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import LinkSettings
from madns_runtime.protocol.messages import Message, Service
from madns_runtime.protocol.states import HOST_LIVE, HostEvent, HostState, host_machine

CHECK_INTERVAL_S = 0.1
"""Interval between two looks at silence and deadlines."""
LINGER_S = 0.5
"""Longest wait of the host at its end for its last acknowledgements to leave."""

_NOT_THERE = (Phase.ABSENT, Phase.JOINING, Phase.STOPPED, Phase.LOST)
_BEFORE_STOP = tuple(state for state in HOST_LIVE if state is not HostState.BEGIN_SHUTDOWN)


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
        wire: LinkSettings,
        *,
        timeouts: Timeouts,
        on_agent_loss: Literal["abort", "continue"],
        now_s: float,
    ) -> None:
        self._events: deque[HostSessionEvent] = deque()
        self._roster = Roster(agents, timeouts, events=self._events, now_s=now_s)
        self.peers = self._roster.peers
        self.agents_in = self._roster.names_in
        self.await_returns = self._roster.await_returns
        self._running = self._roster.running
        self._links = HostLinks(self.peers, wire, self._events)
        self.until_forged = self._links.until_forged
        self.seal_data = self._links.seal_data
        self.datagrams_to_send = self._links.datagrams_to_send
        self._timeouts = timeouts
        self._aborts = on_agent_loss == "abort"
        self._machine = host_machine()
        self._wait = StateWait(now_s, timeouts.agents_ready_s)
        self._check_due_s = now_s
        self._t0_host_s: float | None = None
        self._end_host_s = float("inf")
        self.refused = self._links.refused
        self.malformed_count = 0

    @property
    def state(self) -> HostState:
        """Present state of the host."""
        return self._machine.state

    def setup_finished(self, initial: Mapping[str, Any], now_s: float) -> None:
        """Send each agent its initial data (by name); their readiness is awaited."""
        self._fire(HostEvent.SETUP_FINISHED)
        self._wait.begin(now_s, self._timeouts.agent_setup_s)
        for name, data in initial.items():
            if self.peers[name].phase is Phase.READY:
                self.send_setup(name, data, now_s)
        self._progress(now_s)

    def send_setup(self, agent: str, initial: Any, now_s: float) -> None:
        """Send one agent its initial data: after `AgentRejoining`."""
        peer = self.peers[agent]
        if peer.phase is Phase.READY:
            t_s = 0.0 if self._t0_host_s is None else max(0.0, now_s - self._t0_host_s)
            setup = messages.SimulationSetup(initial, t_s)
            self._links.send(peer, setup, Service.RELIABLE, now_s)
            self._roster.move(peer, Phase.SETTING_UP)

    def start(self, t0_host_s: float, duration_s: float, now_s: float) -> None:
        """Tell every agent that simulated time zero is *t0_host_s* on the host's monotonic clock."""
        self._fire(HostEvent.AGENTS_SIMULATION_READY)
        self._t0_host_s = t0_host_s
        self._end_host_s = t0_host_s + duration_s
        self._wait.begin(now_s, t0_host_s - now_s + duration_s + self._timeouts.complete_s)
        for peer in self.peers.values():
            if peer.phase is Phase.SIMULATION_READY:
                self._start_peer(peer, now_s)
        self._progress(now_s)

    def end_at(self, end_host_s: float) -> None:
        """Take the simulated time to be over at *end_host_s* on the host's clock: agents were told."""
        self._end_host_s = end_host_s
        if self.state is HostState.SIMULATION_START:
            self._wait.until_s = end_host_s + self._timeouts.complete_s

    def order_stop(self, now_s: float) -> None:
        """Tell every agent to flush its records and end."""
        self._fire(HostEvent.STOP_ORDERED)
        self._wait.begin(now_s, self._timeouts.shutdown_s)
        for peer in self.peers.values():
            if peer.phase is Phase.COMPLETE:
                # Behind whatever the host's half has sent: RELIABLE, so that it overtakes nothing.
                self._links.send(peer, messages.SystemStop(), Service.RELIABLE, now_s)
        self._progress(now_s)

    def emergency(self, who: str, reason: str, now_s: float) -> None:
        """Declare an emergency and tell every agent; no effect when already ending."""
        if not self._machine.allows(HostEvent.EMERGENCY):
            return
        self._fire(HostEvent.EMERGENCY)
        self._wait.begin(now_s, self._timeouts.shutdown_s)
        self._events.append(events.EmergencyDeclared(who, reason))
        for peer in self.peers.values():
            if peer.link is not None and peer.phase is not Phase.STOPPED:
                self._links.send(peer, messages.EmergencyShutdown(who, reason), Service.SYNC, now_s)
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
            self._lose({agent: how}, now_s)

    def agent_is_being_killed(self, agent: str, now_s: float) -> None:
        """Take note that an agent was ordered to end without a word: nobody else may be there to tell that it did."""
        self.peers[agent].killed_s = now_s

    def cleaned_up(self) -> None:
        """Simulation and executor are closed."""
        self._fire(HostEvent.CLEANED_UP)

    def records_closed(self, now_s: float) -> None:
        """The host's records are on disk; the session lingers for its last acknowledgements."""
        self._fire(HostEvent.RECORDS_CLOSED)
        self._wait.begin(now_s, LINGER_S)

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
        Send a plug-in's message, or what another agent's has come to; False if that agent is lost or not there yet.

        Raises:
            MessageTooLarge: It does not fit its class of service.
            SendQueueFull: The agent has not taken what was sent before.
        """
        peer = self.peers[agent]
        if peer.link is None or peer.phase in _NOT_THERE:
            peer.not_sent += 1
            return False
        self._links.send_data(peer, payload, service, now_s=now_s, deadline_s=deadline_s)
        return True

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
            self._links.mark(peer)
            self._take(peer, body, now_s, Service.BEST)
            return None
        return peer.name, payload

    def receive_datagram(self, data: bytes, address: Address, now_s: float) -> None:
        """Take one datagram from anywhere; whatever is wrong with it is counted."""
        found = self._links.receive(data, address, now_s)
        if found is None:
            return
        peer, link = found
        if link is not peer.link:
            self._replace(peer, link, now_s)
        while (received := link.next_message()) is not None:
            self._take(peer, received.body, now_s, received.service)

    def get_timer(self) -> float | None:
        """Return when `handle_timer` wants to be called, at the latest."""
        is_over = self.state is HostState.EXIT
        return None if is_over else min(self._check_due_s, self._links.get_timer())

    def handle_timer(self, now_s: float) -> None:
        """Do what is due. Received datagrams must have been handed in before."""
        self._links.handle_timer(now_s)
        if now_s >= self._check_due_s:
            self._check_due_s = now_s + CHECK_INTERVAL_S
            lost = self._roster.find_silent(self.state, now_s, is_over=now_s > self._end_host_s)
            self._lose(lost, now_s)
            if self._roster.is_empty and now_s > self._end_host_s:
                self._roster.are_returns_cut_off = False  # stopped while all were away
                self._progress(now_s)
            self._check_state_deadline(now_s)

    def next_event(self) -> HostSessionEvent | None:
        """Return the oldest event not yet taken."""
        return self._events.popleft() if self._events else None

    def _replace(self, peer: Peer, link: Link, now_s: float) -> None:
        """Go on with another process in an agent's place."""
        if peer.link is not None and peer.phase is not Phase.LOST:
            self._lose({peer.name: "another process took its place"}, now_s)
        self._links.replace(peer, link)
        peer.pid, peer.loss_reason = None, None
        if peer.phase is not Phase.ABSENT:
            # Its hello may come behind a ping, if the first datagram was lost.
            self._roster.move(peer, Phase.JOINING)

    def _take(self, peer: Peer, body: bytes, now_s: float, service: Service) -> None:
        try:
            message = decode_message(body)
        except MalformedMessage:
            self.malformed_count += 1
        else:
            self._receive(peer, message, now_s, service)

    def _receive(self, peer: Peer, message: Message, now_s: float, service: Service) -> None:
        match message:
            case messages.EmergencyShutdown(_, reason):
                # It ends itself: that loses one member, and under abort the run.
                if peer.phase not in (Phase.LOST, Phase.STOPPED):
                    self._lose({peer.name: reason}, now_s)
            case messages.AgentStopped(records) if accounts.are_last_counts(records):
                self._agent_stopped(peer, records, now_s)
            case messages.Hello() if peer.pid is None:
                self._welcome(peer, message, now_s)
            case _ if peer.phase is Phase.LOST:
                self._send_expelled(peer, now_s)
            case messages.SimulationData(payload):
                self._events.append(events.AgentDataReceived(peer.name, payload, service))
            case messages.Transmission(sent_s=t_s) | messages.ConditionMet(t_s=t_s) if isfinite(
                t_s
            ):
                self._events.append(events.AgentDataReceived(peer.name, message))
            case messages.Ping(t_agent_s, report) if not report or accounts.is_report(report):
                peer.report = report or peer.report
                peer.pings.append((t_agent_s, now_s))
                self._links.mark(peer)
            case messages.SimulationReady() if peer.phase is Phase.SETTING_UP:
                self._agent_simulation_ready(peer, now_s)
            case messages.SimulationComplete(summary) if (
                peer.phase is Phase.RUNNING and accounts.is_summary(summary)
            ):
                peer.summary = summary
                self._roster.move(peer, Phase.COMPLETE)
                self._progress(now_s)
            case _:
                # A message that only hosts send, out of turn, or without its shape.
                self.malformed_count += 1

    def _welcome(self, peer: Peer, hello: messages.Hello, now_s: float) -> None:
        peer.pid = hello.pid
        if hello.runtime_version != __version__ or hello.agent != peer.name:
            reason = f"{hello.agent} runs MADNS {hello.runtime_version}, the host {__version__}"
            self._lose({peer.name: reason}, now_s)
            self._send_expelled(peer, now_s)
        elif self.state in (HostState.HOST_STARTUP, HostState.SIMULATION_SETUP):
            self._roster.move(peer, Phase.READY)
            self._progress(now_s)
        elif self.state in (HostState.HOST_SIMULATION_READY, HostState.SIMULATION_START):
            self._roster.move(peer, Phase.READY)
            self._events.append(events.AgentRejoining(peer.name))
        else:
            word = messages.EmergencyShutdown("host", "the run is already ending")
            self._links.send(peer, word, Service.SYNC, now_s)

    def _agent_simulation_ready(self, peer: Peer, now_s: float) -> None:
        if self.state is HostState.SIMULATION_START:
            self._start_peer(peer, now_s)
            peer.loss_reason = None
            self._events.append(events.AgentRejoined(peer.name))
        else:
            self._roster.move(peer, Phase.SIMULATION_READY)
            self._progress(now_s)

    def _start_peer(self, peer: Peer, now_s: float) -> None:
        if self._t0_host_s is not None:
            self._links.send(peer, messages.SimulationStart(self._t0_host_s), Service.SYNC, now_s)
            self._roster.move(peer, Phase.RUNNING)

    def _agent_stopped(self, peer: Peer, records: Mapping[str, Any], now_s: float) -> None:
        peer.records = records
        if self.state in _BEFORE_STOP and peer.phase is not Phase.LOST:
            self._lose({peer.name: "it stopped before it was told to"}, now_s)
        elif peer.phase is not Phase.LOST:
            self._roster.move(peer, Phase.STOPPED)
        self._progress(now_s)

    def _send_expelled(self, peer: Peer, now_s: float) -> None:
        if peer.loss_reason is not None and self.state in HOST_LIVE:
            self._links.send(peer, messages.Expelled(peer.loss_reason), Service.SYNC, now_s)
            peer.loss_reason = None  # said once an incarnation

    def _fire(self, event: HostEvent) -> None:
        self._events.append(events.HostStateEntered(self._machine.fire(event)))

    def _lose(self, reasons: Mapping[str, str], now_s: float) -> None:
        """Take agents, by name, for lost: an emergency, unless the run may lose them and some are left."""
        if not reasons:
            return
        is_live = self.state in HOST_LIVE
        self._roster.lose(reasons, is_live=is_live)
        if is_live and (self._aborts or self._roster.are_all_lost):
            self.emergency(", ".join(reasons), "; ".join(dict.fromkeys(reasons.values())), now_s)
        else:
            self._progress(now_s)

    def _progress(self, now_s: float) -> None:
        """Move on when nobody is waited for any more."""
        state = self.state
        if state in ENDING:
            if not self._roster.names_outside(Phase.STOPPED, Phase.ABSENT):
                self._stop(now_s, ())
        elif state in AWAITED and self._roster.are_settled(AWAITED[state][1]):
            self._go_on(state, now_s)

    def _go_on(self, state: HostState, now_s: float) -> None:
        """Take the step that every agent was awaited for."""
        if state is HostState.HOST_STARTUP:
            self._fire(HostEvent.AGENTS_READY)
            self._wait.begin(now_s, self._timeouts.host_setup_s)
            self._events.append(events.AgentsReady())
        elif state is HostState.HOST_SIMULATION_READY:
            self._events.append(events.AgentsSimulationReady())
        else:
            self._fire(HostEvent.AGENTS_COMPLETE)
            self._wait.begin(now_s, self._timeouts.shutdown_s)
            self._events.append(events.AgentsComplete())

    def _stop(self, now_s: float, missing: tuple[str, ...]) -> None:
        self._fire(HostEvent.AGENTS_STOPPED)
        self._wait.begin(now_s, self._timeouts.shutdown_s)
        self._events.append(events.AgentsStopped(missing))

    def _check_state_deadline(self, now_s: float) -> None:
        """End a wait that is over: whoever did not answer is lost, all of them named at once."""
        if not self._wait.is_over(now_s):
            return
        state = self.state
        waited_s = self._wait.lasted_s(now_s)
        if state in AWAITED:
            word, phase = AWAITED[state]
            self._wait.until_s = now_s + self._timeouts.silence_s
            reason = f"no {word} in {waited_s:g} s"
            self._roster.awaits_returns = False
            self._lose(dict.fromkeys(self._roster.names_outside(phase), reason), now_s)
            if self._roster.are_all_lost:
                self.emergency(", ".join(self.peers), f"{reason}: none has returned", now_s)
        elif state is HostState.SIMULATION_SETUP:
            self.emergency("host", f"setup of the simulation took over {waited_s:g} s", now_s)
        elif state in ENDING:
            self._stop(now_s, self._roster.names_outside(Phase.STOPPED, Phase.ABSENT))
        elif state is HostState.WAITING_SERVER_STOP:
            self._fire(HostEvent.SERVER_STOPPED)
