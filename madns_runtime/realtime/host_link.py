"""The host's link to its agents: its socket, its session, and the simulated time that it has given out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any

from madns_runtime.config import HostLaunch
from madns_runtime.faults.message_faults import MessageFaults
from madns_runtime.medium.carrier import Carrier
from madns_runtime.plugin.context import check_sending
from madns_runtime.protocol.bundle import bundle_up, is_bundle, split
from madns_runtime.protocol.host_peers import Address
from madns_runtime.protocol.host_session import HostSession
from madns_runtime.protocol.link_settings import LinkLimits, LinkSettings
from madns_runtime.protocol.messages import Delivery, Service, TransmissionRefusal
from madns_runtime.protocol.states import HostState
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.udp import UdpSocket
from madns_runtime.timing.rate import last_period_s

BEST, SYNC = Service.BEST, Service.SYNC

PACE_TOTAL_BYTES_PER_S = 100e6
"""Rate of RELIABLE fragments to all agents together, beyond bursts: most of a gigabit network."""


class HostPort:
    """
    The socket and the session of the host.

    Args:
        launch: The run.
        reactor: The loop.
        on_due: Called when the session's timer is due.

    Raises:
        MachineError: The socket cannot be opened, as where its port is taken.
    """

    def __init__(self, launch: HostLaunch, *, reactor: Reactor, on_due: Callable[[], None]) -> None:
        config = launch.config
        names = config.agents.resolved_names()
        self.socket = UdpSocket.bind(
            config.network.address,
            config.network.port,
            receive_buffer_bytes=config.network.receive_buffer_bytes,
        )
        limits = LinkLimits(
            receive_window_bytes=window_bytes(self.socket.receive_buffer_bytes, len(names)),
            pace_bytes_per_s=PACE_TOTAL_BYTES_PER_S / len(names),
        )
        self.session = HostSession(
            names,
            LinkSettings(
                run_key=bytes.fromhex(launch.run_key_hex),
                session=bytes.fromhex(launch.session_hex),
                limits=limits,
            ),
            timeouts=config.timeouts,
            on_agent_loss=config.on_agent_loss,
            now_s=reactor.now_s(),
        )
        self.carrier = Carrier(names, self._hand_over, self.now_s, end_s=config.time.duration_s)
        """Messages between agents."""
        self.t0_s: float | None = None
        """Simulated time zero on this machine's monotonic clock; None before it is set."""
        self.faults: MessageFaults | None = None
        """Sees what the host's half sends, while faults are in force."""
        self.must_pump = False
        """Whether something waits to be sent or carried out."""
        self._kept_for: Address | None = None
        self._kept: list[bytes] = []
        self._lead_s = config.timeouts.start_lead_s
        # Ticks are spread over their periods: the last ones may be due behind the end.
        self._last_s = last_period_s(config.time.duration_s, config.agents.tick_hz)
        # Infinite is never: the timer is made once and moved.
        self._timer = reactor.call_at(math.inf, on_due)

    def tell_start(self, now_s: float) -> None:
        """Tell every agent when simulated time begins, once that is set."""
        if self.t0_s is not None:
            self.session.start(self.t0_s, self._last_s, now_s)

    def flush(self) -> None:
        """Send what is due, and what soon arrives of messages between agents."""
        if self.is_in(HostState.SIMULATION_START):
            self.carrier.hand_over()
        for data, address in self.session.datagrams_to_send(monotonic()):
            self._post(data, address)

    def read(self, take: Callable[[bytes, Address], None]) -> None:
        """
        Hand the datagrams of one packet, if one waits, to *take*; what it sends to their sender leaves together.

        The loop looks for more: most often there is one.
        """
        received = self.socket.receive_from()
        if received is None:
            return
        packet, address = received
        datagrams = split(packet) if is_bundle(packet) else None
        if datagrams is None:
            take(packet, address)
            return
        self._kept_for = address
        try:
            for datagram in self.session.until_forged(datagrams):
                take(datagram, address)
        finally:
            kept, self._kept, self._kept_for = self._kept, [], None
            if kept:
                for bundle in bundle_up(kept):
                    self.socket.send(bundle, address)

    def waiting(self) -> Iterator[tuple[bytes, Address]]:
        """
        Yield the datagrams that wait in the socket, of a bounded number of packets.

        The session must have taken each before the next is asked for.
        """
        for packet, address in self.socket.receive_all():
            datagrams = split(packet) if is_bundle(packet) else None
            for datagram in (
                (packet,) if datagrams is None else self.session.until_forged(datagrams)
            ):
                yield datagram, address

    def _post(self, data: bytes, address: Address) -> None:
        if address == self._kept_for:
            self._kept.append(data)
        else:
            self.socket.send(data, address)

    def arm(self) -> None:
        """Arm the session's timer, for what is to be handed over as well."""
        session_s = self.session.get_timer()
        due_s = math.inf if session_s is None else session_s
        if self.is_in(HostState.SIMULATION_START):
            due_s = min(due_s, self.due_s(self.carrier.next_s()))
        self._timer.reschedule(due_s)

    def monotonic_s(self) -> float:
        """Return the time of this machine's monotonic clock, s."""
        return monotonic()

    def want_pump(self) -> None:
        """Note that something waits to be carried out."""
        self.must_pump = True

    def is_in(self, state: HostState) -> bool:
        """Tell whether the session is in *state*."""
        return self.session.state is state

    # Towards the simulation ------------------------------------------------------------------------

    def listening(self) -> dict[str, Any]:
        """Return the event that tells where agents find the host."""
        address, port = self.socket.address[:2]
        return {"event": "listening", "address": address, "port": port}

    def now_s(self) -> float:
        """Return the simulated time, s."""
        return -self._lead_s if self.t0_s is None else monotonic() - self.t0_s

    def t_s(self) -> float | None:
        """Return the simulated time, s; None before it runs."""
        return None if self.t0_s is None else self.now_s()

    def due_s(self, t_s: float | None, *, end_s: float = math.inf) -> float:
        """
        Return when this machine's monotonic clock will show simulated time *t_s*, s: what a timer waits for.

        It is infinite, never, for None, for a time behind *end_s*, and before simulated time is set.
        """
        if self.t0_s is None or t_s is None or t_s > end_s:
            return math.inf
        return self.t0_s + t_s

    def send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> None:
        """Send to an agent's half; see `plugin.api.Context.send`."""
        if self.faults is not None:
            # What cannot be sent is told to who sends it, not to nobody when its time has come.
            is_running = self.t0_s is not None
            check_sending(to, self.session.peers, service, deadline_s, is_running=is_running)
            if self.faults.send(to, message, service, deadline_s):
                return
        now_s = monotonic()
        if service is BEST and deadline_s is None:
            sealed = self.session.seal_data(to, message, now_s)
            if sealed is not None:
                self._post(*sealed)
                return
        peers, t0_s = self.session.peers, self.t0_s
        check_sending(to, peers, service, deadline_s, is_running=t0_s is not None)
        due_s = None if deadline_s is None or t0_s is None else t0_s + deadline_s
        self.session.send(to, message, service, now_s, deadline_s=due_s)
        self.must_pump = True
        if service is SYNC:
            self.flush()

    def _hand_over(self, to: str, message: Delivery | TransmissionRefusal) -> bool:
        return self.session.send(to, message, Service.RELIABLE, monotonic())


def window_bytes(receive_buffer_bytes: int, peers: int) -> int:
    """Return the window granted to each of *peers*, so that all together fit the socket's buffer."""
    # The kernel charges a small datagram with more than its bytes: half the buffer is kept for that.
    return max(4 * 1400, receive_buffer_bytes // 2 // max(1, peers))
