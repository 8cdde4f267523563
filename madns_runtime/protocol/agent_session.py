"""
An agent's side of a run, pure: datagrams and now_s in, datagrams and events out.

Owns the link to the host, the agent's state machine, the estimate of the host's clock and every
deadline. The composition root feeds it and carries out what its events say.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from madns_runtime.config import Timeouts
from madns_runtime.protocol import events, messages
from madns_runtime.protocol.codec import (
    NO_DATA,
    MalformedMessage,
    decode_data,
    decode_message,
    encode_data,
    encode_message,
)
from madns_runtime.protocol.events import AgentSessionEvent
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import PLUGIN_CHANNEL, LinkSettings
from madns_runtime.protocol.messages import ConditionMet, Message, Service, Transmission
from madns_runtime.protocol.ping_plan import PingPlan
from madns_runtime.protocol.silence_limits import Wakefulness, host_silence_limit_s
from madns_runtime.protocol.states import AGENT_LIVE, AgentEvent, AgentState, agent_machine
from madns_runtime.timing.clocksync import ClockEstimate

PING_INTERVAL_FIRST_S = 0.02
REPORT_INTERVAL_S = 0.9
"""Time between two pings that tell how the agent fares; making that up costs more than the exchange of times."""
PINGS_FIRST = 12
"""The first exchanges follow closely, so that a clock estimate stands before T0."""
CLOCK_ERROR_S_MAX = 0.02
CLOCK_WAIT_S = 2.0
"""An agent is ready once it knows the host's clock this well, or has tried for this long."""
CLOCK_ERROR_S_FINE = 0.001
"""Of what is known less well when the start is ordered, more is learnt before simulated time begins ..."""
UNUSED_S = 0.02
"""... and until so long before, when nothing relies on it yet, it is believed at once."""
LINGER_S = 1.0
"""Longest wait of an agent at its end for its last words to be acknowledged."""
HELD_MAX = 1024
"""Messages that may wait for the agent's half to be set up."""

_RUNNING = AgentState.RUN_SIMULATION


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentIdentity:
    """Identity of an agent on the wire; *incarnation_id* is random, new at every start."""

    name: str
    index: int
    incarnation_id: int
    runtime_version: str
    pid: int


class AgentSession:
    """
    One agent's conversation with the host.

    Args:
        identity: Who speaks.
        wire: The run's secret and the bounds of the link.
        timeouts: The run's deadlines.
        report: Called now and then; what it returns is told with a ping and shown to the operator.
        now_s: Present time of the local monotonic clock.
        clock: Estimate of the host's clock, shared with other agents of the process; None for one of its own.
        pings: When it exchanges times with the host.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        identity: AgentIdentity,
        wire: LinkSettings,
        *,
        timeouts: Timeouts,
        report: Callable[[], Mapping[str, Any]],
        now_s: float,
        clock: ClockEstimate | None = None,
        pings: PingPlan = PingPlan(),  # noqa: B008 - frozen
    ) -> None:
        self.identity = identity
        self.clock = clock or ClockEstimate()
        self.link = Link.for_agent(
            wire.run_key,
            wire.session,
            identity.index,
            identity.incarnation_id,
            limits=wire.limits,
        )
        self.datagrams_to_send = self.link.datagrams_to_send
        self.next_broken_deadline = self.link.next_broken_deadline
        self._timeouts = timeouts
        self._report = report
        self._machine = agent_machine()
        self._events: deque[AgentSessionEvent] = deque()
        self._heard_s: float | None = None
        self.answered_s = self.answer_heard_s = -math.inf
        """When the newest ping was sent that the host has answered, and when the answer came."""
        self._wakefulness = Wakefulness(timeouts.silence_s, now_s)
        self._pings = pings
        self.ping_due_s = now_s if pings.brings_clock_up else now_s + pings.delay_s
        """When to say how it is; `handle_timer` does so. The timer comes `ping_slack_s` later."""
        self._report_due_s = now_s
        self.ping_slack_s = 0.0
        """Time in which something else, such as a tick, wakes the loop for a ping that is due; see `wait_for_ticks`."""
        self._pings_closely = PINGS_FIRST if pings.brings_clock_up else 0
        self._state_deadline_s: float | None = (
            now_s + timeouts.agents_ready_s + timeouts.host_setup_s + timeouts.agent_setup_s
        )
        self._ready_due_s: float | None = None
        """Time until which readiness waits for the clock; None while it does not wait."""
        self._t0_host_s = -math.inf
        """Simulated time zero on the host's clock."""
        self._started_s = now_s
        self._held: list[events.HostDataReceived] = []
        self.held_dropped_count = 0
        self.malformed_count = 0
        self._send(
            messages.Hello(identity.name, identity.runtime_version, identity.pid),
            Service.SYNC,
            now_s,
        )

    @property
    def state(self) -> AgentState:
        """Present state of this agent."""
        return self._machine.state

    def wait_for_ticks(self, period_s: float) -> None:
        """Let pings wait a little for ticks, which wake the loop with this period from now on, s."""
        self.ping_slack_s = self._pings.slack_s(period_s)

    def setup_finished(self, now_s: float) -> None:
        """Take note that the agent's half is set up; the host is told once its clock is known here."""
        self._heard_s = now_s  # while it worked, it did not listen
        if self._is_clock_known(now_s):
            self._say_ready(now_s)
            return
        # Work in this process may have kept the answers waiting: what they say of the clock is worth little.
        self._ready_due_s = now_s + CLOCK_WAIT_S
        self.ping_due_s, self._pings_closely = now_s, PINGS_FIRST

    def run_finished(self, summary: Mapping[str, Any], now_s: float) -> None:
        """Say that the simulated time is over; the host's stop is awaited."""
        self._fire(AgentEvent.RUN_FINISHED)
        timeouts = self._timeouts
        self._state_deadline_s = now_s + timeouts.complete_s + timeouts.shutdown_s
        # Behind whatever the agent's half has sent: RELIABLE, so that it overtakes nothing.
        self._send(messages.SimulationComplete(summary), Service.RELIABLE, now_s)

    def records_closed(self, records: Mapping[str, Any], now_s: float) -> None:
        """Say that the records are on disk; the session ends when that is acknowledged."""
        self._fire(AgentEvent.RECORDS_CLOSED)
        self._send(messages.AgentStopped(records), Service.SYNC, now_s)
        self._fire(AgentEvent.STOPPED_SAID)
        self._state_deadline_s = now_s + LINGER_S

    def emergency(self, reason: str, now_s: float) -> None:
        """Declare an emergency and tell the host; no effect when already ending."""
        if self._machine.allows(AgentEvent.EMERGENCY):
            self._send(messages.EmergencyShutdown(self.identity.name, reason), Service.SYNC, now_s)
            self._end(events.EmergencyOrdered(self.identity.name, reason))

    def send(
        self, payload: Any, service: Service, now_s: float, *, deadline_s: float | None = None
    ) -> None:
        """
        Send a plug-in's message to the host's half; *deadline_s* on the local clock, SYNC only.

        Raises:
            MessageTooLarge: It does not fit its class of service.
            SendQueueFull: The host has not taken what was sent before.
        """
        body = encode_data(payload)
        self.link.send(body, service, now_s, channel=PLUGIN_CHANNEL, deadline_s=deadline_s)

    def transmit(self, transmission: Transmission, now_s: float) -> None:
        """
        Send a message for other agents.

        Raises:
            UnencodableValue: It holds what messages do not carry.
            MessageTooLarge: It is longer than messages are.
            SendQueueFull: The host has not taken what was sent before.
        """
        self.link.send(
            encode_message(transmission), Service.RELIABLE, now_s, channel=PLUGIN_CHANNEL
        )

    def condition_met(self, met: ConditionMet, now_s: float) -> None:
        """Tell the host that a condition on this agent's records is met."""
        self._send(met, Service.RELIABLE, now_s)

    def seal_data(self, payload: Any, now_s: float) -> bytes | None:
        """
        Return the datagram of a plug-in's BEST message; None if it must go through `send`.

        Raises:
            UnencodableValue: It holds what messages do not carry.
        """
        return self.link.seal_best(encode_data(payload), now_s, channel=PLUGIN_CHANNEL)

    def receive_data(self, data: bytes, now_s: float) -> Any:
        """
        Take one datagram, as `receive_datagram` does, but return the message of one like most.

        Returns:
            The payload, if all that it brought is one BEST message of the host's half; else NO_DATA,
            and events say what it brought.
        """
        body = None
        if self._machine.state is _RUNNING and not self._events:
            body = self.link.open_best(data, now_s)
        if body is None:
            self.receive_datagram(data, now_s)
            return NO_DATA
        self._heard_s = now_s
        payload = decode_data(body)
        if payload is NO_DATA:
            self._take(body, now_s)
        return payload

    def receive_datagram(self, data: bytes, now_s: float) -> None:
        """Take one datagram; whatever is wrong with it is counted."""
        link = self.link
        if self.state is AgentState.EXIT or not link.receive_datagram(data, now_s):
            return
        self._heard_s = now_s
        while (received := link.next_message()) is not None:
            self._take(received.body, now_s)

    def get_timer(self) -> float | None:
        """Return when `handle_timer` wants to be called, at the latest."""
        if self.state is AgentState.EXIT:
            return None
        times = (
            self.link.get_timer(),
            self.ping_due_s + self.ping_slack_s,
            self._ready_due_s,
            self._state_deadline_s,
        )
        return min(t for t in times if t is not None)

    def handle_timer(self, now_s: float) -> None:
        """Do what is due. Received datagrams must have been handed in before."""
        if self.state is AgentState.EXIT:
            return
        self._wakefulness.called(now_s, self.ping_due_s)
        self.link.handle_timer(now_s)
        if now_s >= self.ping_due_s:
            self._ping(now_s)
        if self._ready_due_s is not None and now_s >= self._ready_due_s:
            self._say_ready(now_s)
        self._check_deadlines(now_s)

    def next_event(self) -> AgentSessionEvent | None:
        """Return the oldest event not yet taken."""
        return self._events.popleft() if self._events else None

    def _fire(self, event: AgentEvent) -> None:
        self._events.append(events.AgentStateEntered(self._machine.fire(event)))

    def _send(self, message: Message, service: Service, now_s: float) -> None:
        self.link.send_urgent(encode_message(message), service, now_s)

    def _take(self, body: bytes, now_s: float) -> None:
        try:
            message = decode_message(body)
        except MalformedMessage:
            self.malformed_count += 1
        else:
            self._receive(message, now_s)

    def _receive(self, message: Message, now_s: float) -> None:
        match message:
            case messages.SimulationData(payload):
                self._take_data(payload)
            case _ if isinstance(message, messages.WITH_DATA):
                self._take_data(message)
            case messages.Pong(t_agent_s, t_host_received_s, t_host_sent_s):
                self.answered_s, self.answer_heard_s = max(self.answered_s, t_agent_s), now_s
                self.clock.add_exchange(t_agent_s, t_host_received_s, t_host_sent_s, now_s)
                if self._is_clock_unused(now_s):
                    self.clock.settle(now_s, is_unused=True)
                self._events.append(events.ClockEstimated())
                if self._ready_due_s is not None and self._is_clock_known(now_s):
                    self._say_ready(now_s)
            case messages.SimulationSetup(initial, t_s):
                self._move(AgentEvent.SETUP_RECEIVED, events.SetupReceived(initial, t_s))
            case messages.SimulationStart(t0_host_s):
                if self._machine.allows(AgentEvent.START_RECEIVED):
                    self.clock.settle(now_s)
                    self._start_is_near(t0_host_s, now_s)
                self._move(AgentEvent.START_RECEIVED, events.StartReceived(t0_host_s))
            case messages.SystemStop():
                self._move(AgentEvent.STOP_RECEIVED, events.StopReceived())
            case messages.EmergencyShutdown(who, reason):
                self._end(events.EmergencyOrdered(who, reason))
            case messages.Expelled(reason):
                self._end(events.ExpelledFromRun(reason))
            case _:
                self.malformed_count += 1  # a message that only agents send

    def _take_data(self, payload: Any) -> None:
        event = events.HostDataReceived(payload)
        if self.state not in (AgentState.AGENT_READY, AgentState.SIMULATION_SETUP):
            self._events.append(event)
        elif len(self._held) < HELD_MAX:
            self._held.append(event)  # until the agent's half can take it
        else:
            self.held_dropped_count += 1

    def _move(self, event: AgentEvent, outcome: AgentSessionEvent) -> None:
        if self._machine.allows(event):
            self._fire(event)
            self._state_deadline_s = None  # the agent's own work now; the host times it
            self._events.append(outcome)
        else:
            self.malformed_count += 1

    def _end(self, outcome: events.EmergencyOrdered | events.ExpelledFromRun) -> None:
        if self._machine.allows(AgentEvent.EMERGENCY):
            self._ready_due_s = None
            self._move(AgentEvent.EMERGENCY, outcome)

    def _is_clock_known(self, now_s: float) -> bool:
        return self.clock.is_valid and self.clock.error_s(now_s) <= CLOCK_ERROR_S_MAX

    def _start_is_near(self, t0_host_s: float, now_s: float) -> None:
        self._t0_host_s = t0_host_s
        is_coarse = self.clock.error_s(now_s) > CLOCK_ERROR_S_FINE
        if self._pings.brings_clock_up and is_coarse and self._is_clock_unused(now_s):
            self.ping_due_s, self._pings_closely = now_s, PINGS_FIRST

    def _is_clock_unused(self, now_s: float) -> bool:
        """Whether simulated time is ordered to begin, and is not about to."""
        return self.clock.is_valid and self.clock.to_host_s(now_s) < self._t0_host_s - UNUSED_S

    def _say_ready(self, now_s: float) -> None:
        self._ready_due_s = None
        self._fire(AgentEvent.SETUP_FINISHED)
        self._state_deadline_s = now_s + self._timeouts.agent_setup_s + self._timeouts.silence_s
        self._send(messages.SimulationReady(), Service.SYNC, now_s)
        self._events.extend(self._held)
        self._held.clear()

    def _ping(self, now_s: float) -> None:
        is_first = self._pings_closely > 0
        self._pings_closely -= is_first
        if self._pings_closely:
            self.ping_due_s = now_s + PING_INTERVAL_FIRST_S
        else:
            self.ping_due_s = self._pings.next_s(self._started_s, now_s)
        report: Mapping[str, Any] = {}
        if now_s >= self._report_due_s:
            report = self._report()
            self._report_due_s = now_s + REPORT_INTERVAL_S
        self._send(messages.Ping(now_s, report), Service.BEST, now_s)

    def _check_deadlines(self, now_s: float) -> None:
        state = self.state
        if state is AgentState.WAITING_SERVER_STOP:
            deadline_s = self._state_deadline_s
            if self.link.is_flushed or (deadline_s is not None and now_s >= deadline_s):
                self._fire(AgentEvent.SERVER_STOPPED)
                self._events.append(events.SessionEnded())
            return
        if state not in AGENT_LIVE:
            return
        if self._heard_s is None and now_s - self._started_s > self._timeouts.agents_ready_s:
            waited_s = self._timeouts.agents_ready_s
            self.emergency(
                f"host: no answer to HELLO in {waited_s:g} s; is its address and UDP port reachable"
                " from here?",
                now_s,
            )
        elif self._state_deadline_s is not None and now_s >= self._state_deadline_s:
            self.emergency(f"host: no order to go on from {state.value} before its deadline", now_s)
        elif self._heard_s is not None:
            silent_s = now_s - max(self._heard_s, self._wakefulness.blameless_until_s)
            limit_s = host_silence_limit_s(state, self._timeouts)
            if silent_s > limit_s:
                # It is told as well: it may only have been stuck.
                self.emergency(f"host: silent for {limit_s:g} s", now_s)
