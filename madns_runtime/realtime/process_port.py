"""
The one UDP socket of an agent process, and its one estimate of the host's clock.

What its agents send together leaves as one packet, and what comes is dealt out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from time import monotonic

from madns_runtime.config import AgentLaunch
from madns_runtime.faults.clock_faults import FaultableClock
from madns_runtime.protocol.bundle import bundle_up, is_bundle, split
from madns_runtime.protocol.datagram import agent_index_of
from madns_runtime.protocol.ping_plan import PING_INTERVAL_S, PINGS_PER_SILENCE, PingPlan
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import freeze_garbage
from madns_runtime.reactor.udp import UdpSocket
from madns_runtime.realtime.loop_account import NOBODY, LoopAccount, Span
from madns_runtime.recording.writer_thread import WriterThread
from madns_runtime.timing.late_causes import Cause

RECEIVE_BUFFER_BYTES = 1024 * 1024
"""Receive buffer asked for per agent ..."""
RECEIVE_BUFFER_BYTES_MAX = 4 * 1024 * 1024
"""... and by one process at most."""
WINDOW_BYTES_MIN = 4 * 1400
PINGING_OFTEN_MAX = 8
"""Agents of one process that all ping as often as one alone; more share the work ..."""
PING_SLOWED_MAX = 4.0
"""... down to so many times more rarely."""
PACKETS_BATCH_MAX = 64
"""Packets taken from the socket in a row before timers get their turn."""
MOVED_S = 10e-6
"""A clock that has moved by more before simulated time begins has the first ticks' timers set anew."""


LEFT = "old_incarnation"
"""Reason of a refusal, as at the host."""


class ProcessPort:
    """
    The socket and the clock that the agents of one process share.

    Args:
        launch: The run.
        reactor: The loop.
        agents: How many agents share it.

    Raises:
        MachineError: There is no socket to be had.
    """

    def __init__(self, launch: AgentLaunch, reactor: Reactor, agents: int) -> None:
        asked_bytes = min(agents * RECEIVE_BUFFER_BYTES, RECEIVE_BUFFER_BYTES_MAX)
        self.socket = socket = UdpSocket.connect(
            launch.host_address, launch.host_port, receive_buffer_bytes=asked_bytes
        )
        self.agents = agents
        self.clock = FaultableClock()
        self.writer = WriterThread(launch.config.recording)
        self.account = LoopAccount(reactor, self.writer, agents)
        # The kernel charges a small datagram with more than its bytes: half the buffer is kept for that.
        share_bytes = socket.receive_buffer_bytes // max(4, 2 * agents)
        self.window_bytes = max(WINDOW_BYTES_MIN, share_bytes)
        """Bytes that may be on their way to each agent unread, so that all together fit the socket's buffer."""
        self._reactor = reactor
        self._silence_s = launch.config.timeouts.silence_s
        self._made = 0
        self.awaited = 0
        """Agents of the process that have ended and will return to it."""
        self._is_open = False
        self._is_frozen = False
        self._takers: dict[int, Callable[[bytes], None]] = {}
        self._only: Callable[[bytes], None] | None = None
        """Takes whatever comes, of a process that is one agent's."""
        self._refusals: dict[int, Callable[[str], None]] = {}
        self._left: set[int] = set()
        """Agents that have ended here: the host sends to them until it knows."""
        self._packets_max = PACKETS_BATCH_MAX if agents > 1 else 1
        self.after_packet: Callable[[], None] | None = None
        """Called when packets that came have been dealt out."""
        self._waiting: list[bytes] = []
        self._depth = 0
        self.arms: list[Callable[[], None]] = []
        """Each sets the timer of a pack's next tick by the clock."""
        self._armed_offset_s = math.nan

    def pings(self) -> PingPlan:
        """Return when the next agent, of those that are made one after the other, exchanges times with the host."""
        number, self._made = self._made, self._made + 1
        slowed = min(max(1.0, self.agents / PINGING_OFTEN_MAX), PING_SLOWED_MAX)
        interval_s = min(PING_INTERVAL_S * slowed, self._silence_s / PINGS_PER_SILENCE)
        return PingPlan(
            brings_clock_up=number == 0,
            # One that returns takes a place, too: beyond an interval it would be silent until it is lost.
            delay_s=interval_s * (number % self.agents + 1) / self.agents,
            interval_s=interval_s,
        )

    def follow_clock(self) -> None:
        """Set the timers of all ticks anew if the clock has moved, whichever agent has learnt it: before simulated time begins."""
        offset_s = self.clock.offset_s(monotonic())
        if not abs(offset_s - self._armed_offset_s) <= MOVED_S:
            self._armed_offset_s = offset_s
            for arm in self.arms:
                arm()

    def freeze(self) -> None:
        """Take what set-up made out of the collector's way, so that it is not walked in mid-run: once for all agents."""
        if not self._is_frozen:
            self._is_frozen = True
            freeze_garbage()

    def loop(self) -> dict[str, int]:
        """Return how often the loop has waited, and set its timer; it is one for all agents of the process."""
        return {"waits": self._reactor.waits, "timer_settings": self._reactor.timer_settings}

    # Receiving.

    def listen(
        self,
        agent_index: int,
        take: Callable[[bytes], None],
        refuse: Callable[[str], None] = lambda reason: None,
    ) -> None:
        """
        Listen for an agent.

        Args:
            agent_index: Its index on the wire.
            take: Is handed the datagrams for it, and those that are nobody's.
            refuse: Counts a datagram that is for an agent which has left, by the reason.
        """
        if not self._is_open:
            self._is_open = True
            self._reactor.add_reader(self.socket.fileno(), self._readable)
        self._takers[agent_index], self._refusals[agent_index] = take, refuse
        self._only = take if self.agents == 1 else None
        self._left.discard(agent_index)

    def leave(self, agent_index: int) -> None:
        """Listen for an agent no more; the last one closes the socket."""
        self._takers.pop(agent_index, None)
        self._only = None
        self._refusals.pop(agent_index, None)
        self._left.add(agent_index)
        self.close_if_unused()

    def close_if_unused(self) -> None:
        """Close the socket of which no agent hears, unless one is to return."""
        if not self._takers and not self.awaited and self._is_open:
            self._is_open = False
            self._reactor.remove_reader(self.socket.fileno())
            self.socket.close()
            self.account.close()

    def drain(self) -> None:
        """Take what waits in the socket, a bounded number of packets."""
        for packet, _ in self.socket.receive_all():
            self._deal_out(packet)

    def _readable(self) -> None:
        began_s = monotonic()
        # Of an agent by itself one datagram, and back to the loop, which looks for more: most often there is one.
        for _ in range(self._packets_max):
            packet = self.socket.receive()
            if packet is None:
                break
            self._deal_out(packet)
        self.account.add(Span(Cause.RECEIVING, NOBODY, began_s, monotonic()))
        if self.after_packet is not None:  # whose time is its own in the account
            self.after_packet()

    def _deal_out(self, packet: bytes) -> None:
        datagrams = split(packet) if is_bundle(packet) else None
        if datagrams is None:
            if self._only is None:
                self._give(packet)
            else:
                self._only(packet)
            return
        self.begin()
        try:
            for datagram in datagrams:
                self._give(datagram)
        finally:
            self.end()

    def _give(self, datagram: bytes) -> None:
        takers = self._takers
        index = agent_index_of(datagram)
        take = takers.get(index)
        if take is None and index in self._left:
            for refuse in itertools.islice(self._refusals.values(), 1):
                refuse(LEFT)
            return
        if take is None:
            # Nobody's: refused, and counted, by whoever is first.
            take = next(iter(takers.values()), None)
        if take is not None:
            take(datagram)

    # Sending.

    def begin(self) -> None:
        """Keep what is sent until `end`, which is owed whatever happens; blocks may lie in each other."""
        self._depth += 1

    def end(self) -> None:
        """Send what was kept, at the end of the outermost block: as few packets as hold it."""
        self._depth -= 1
        if not self._depth and self._waiting:
            self.send_waiting()

    def send(self, datagram: bytes) -> None:
        """Send a datagram: now, or with others at the end of the block under way."""
        if self._depth:
            self._waiting.append(datagram)
        else:
            self.socket.send(datagram)

    def send_waiting(self) -> None:
        """Send what is kept, now."""
        waiting = self._waiting
        if waiting:
            for packet in bundle_up(waiting):
                self.socket.send(packet)
            waiting.clear()
