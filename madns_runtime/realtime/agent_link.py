"""An agent's link to the host: its share of the process's socket, its session, and simulated time as that knows it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

from madns_runtime import __version__
from madns_runtime.conditions.tap import ConditionTap
from madns_runtime.config import AgentLaunch
from madns_runtime.errors import MadnsError
from madns_runtime.medium.mailbox import Mailbox
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.context import check_sending
from madns_runtime.plugin.half import RoleProgram
from madns_runtime.protocol.agent_session import AgentIdentity, AgentSession
from madns_runtime.protocol.link_settings import LinkLimits, LinkSettings
from madns_runtime.protocol.messages import ConditionMet, Service, Transmission
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.realtime.process_port import ProcessPort

BEST, SYNC = Service.BEST, Service.SYNC


class AgentPort:
    """
    The session of one agent, on the socket of its process.

    Args:
        name: The agent's.
        launch: The run.
        program: What it runs.
        reactor: The loop.
        process: The socket, and the clock, of the agent's process.
        on_due: Called when the session's timer is due.
        report: Returns what a ping tells of the agent.
        counted: What conditions have counted in its earlier incarnation in this process.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        name: str,
        launch: AgentLaunch,
        *,
        program: RoleProgram,
        reactor: Reactor,
        process: ProcessPort,
        on_due: Callable[[], None],
        report: Callable[[], Mapping[str, Any]],
        counted: Mapping[int, int],
    ) -> None:
        config = launch.config
        self.process = process
        self.session = AgentSession(
            AgentIdentity(
                name=name,
                index=config.agents.resolved_names().index(name) + 1,
                incarnation_id=int.from_bytes(os.urandom(4)),
                runtime_version=__version__,
                pid=os.getpid(),
            ),
            LinkSettings(
                run_key=bytes.fromhex(launch.run_key_hex),
                session=bytes.fromhex(launch.session_hex),
                limits=LinkLimits(receive_window_bytes=process.window_bytes),
            ),
            timeouts=config.timeouts,
            report=report,
            now_s=reactor.now_s(),
            clock=process.clock,
            pings=process.pings(),
        )
        self.mailbox = Mailbox(
            name,
            config.agents.resolved_names(),
            has_medium=program.has_medium,
            post=self._transmit,
            incarnation=program.incarnation,
        )
        self.conditions = ConditionTap(
            name,
            config.conditions,
            tick_hz=config.agents.tick_hz,
            now_s=self.now_s,  # the present time also in the set-up of an agent that returns
            report=self._condition_met,
            counted=counted,
        )
        """Conditions that are waited for in this agent's records."""
        self.t0_host_s: float | None = None
        """Simulated time zero on the host's clock; None before it is known."""
        self._rejoined_at_s: float | None = None
        """Simulated time zero on this machine's clock, as an agent that rejoins knows it while it sets up."""
        self.too_late = 0
        """Messages and orders of the host's that came when the agent's half was called no more."""
        self.must_flush = False
        """Whether something waits to be sent."""
        self._lead_s = config.timeouts.start_lead_s
        # Infinite is never: the timer is made once and moved.
        self._timer = reactor.call_at(math.inf, on_due)

    def listen(self, take: Callable[[bytes], None]) -> None:
        """Hand the datagrams for this agent to *take*."""
        self.process.listen(self.session.identity.index, take, self.session.link.refuse)

    def flush(self) -> None:
        """Send what is due, and arm the session's timer."""
        self.must_flush = False
        session, send = self.session, self.process.send
        for data in session.datagrams_to_send(monotonic()):
            send(data)
        due_s = session.get_timer()
        self._timer.reschedule(math.inf if due_s is None else due_s)

    def close(self) -> None:
        """Send the last words, and listen no more."""
        self.flush()
        self._timer.cancel()
        self.process.send_waiting()
        self.process.leave(self.session.identity.index)

    def network(self) -> dict[str, Any]:
        """Return the socket's counters; it is one for all agents of the process, whose number stands beside."""
        return {**self.process.socket.counters(), "agents_sharing": self.process.agents}

    # Towards the simulation ------------------------------------------------------------------------

    def now_s(self) -> float:
        """Return the simulated time, s."""
        if self.t0_host_s is not None:
            return self.session.clock.to_host_s(monotonic()) - self.t0_host_s
        if self._rejoined_at_s is not None:
            return monotonic() - self._rejoined_at_s
        return -self._lead_s

    def rejoin_at(self, t_s: float) -> None:
        """Take simulated time to be *t_s*, s, until the clock is set; 0 where it has not begun."""
        self._rejoined_at_s = monotonic() - t_s if t_s > 0.0 else None

    @property
    def has_rejoined(self) -> bool:
        """Whether the agent was set up while simulated time ran already."""
        return self._rejoined_at_s is not None

    def at(self, local_s: float) -> float:
        """Return the simulated time when this machine's monotonic clock shows *local_s*, s; it must have begun."""
        return self.session.clock.to_host_s(local_s) - self.t0_host_s  # type: ignore[operator]  # each tick

    def t_s(self) -> float | None:
        """Return the simulated time, s; None before it runs."""
        return None if self.t0_host_s is None else self.now_s()

    def local_s(self, t_s: float) -> float:
        """
        Return when simulated time *t_s* is on this machine's monotonic clock, s.

        Raises:
            MadnsError: Simulated time has not begun.
        """
        if self.t0_host_s is None:
            raise MadnsError("simulated time has not begun")
        return self.session.clock.to_local_s(self.t0_host_s + t_s)

    def send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> int | None:
        """Send to the host's half or to other agents; see `plugin.api.Context.send`."""
        now_s = monotonic()
        if service is BEST and to == HOST and deadline_s is None:
            datagram = self.session.seal_data(message, now_s)
            if datagram is not None:
                self.process.send(datagram)
                return None
        if to != HOST:
            return self.mailbox.send(to, message, service, deadline_s)
        is_running = self.t0_host_s is not None
        check_sending(to, (HOST,), service, deadline_s, is_running=is_running)
        due_s = None if deadline_s is None else self.local_s(deadline_s)
        self.session.send(message, service, now_s, deadline_s=due_s)
        self.must_flush = True
        if service is SYNC:
            self.flush()
            self.process.send_waiting()
        return None

    def _condition_met(self, number: int, agent: str, t_s: float) -> None:
        del agent  # this one
        self.session.condition_met(ConditionMet(number, t_s), monotonic())
        self.must_flush = True

    def _transmit(self, transmission: Transmission) -> None:
        self.session.transmit(transmission, monotonic())
        self.must_flush = True
