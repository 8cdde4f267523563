"""A seeded simulated wire between two links, in pure time: what it does to datagrams is repeatable."""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass, field

from harness.host_links import host_link

from madns_runtime.protocol.deadlines import BrokenDeadline
from madns_runtime.protocol.incoming import Received
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import LinkLimits
from madns_runtime.protocol.messages import Service

RUN_KEY = bytes(range(32))
SESSION = b"session1"


@dataclass(frozen=True)
class Faults:
    """What the wire does. Probabilities for each datagram; delays in seconds."""

    loss: float = 0.0
    duplication: float = 0.0
    corruption: float = 0.0
    delay_s: float = 0.001
    jitter_s: float = 0.0  # drawn evenly: what is larger than the distance of datagrams reorders


PERFECT = Faults()


@dataclass
class End:
    """One side: its link, what its owner got, and whether its process runs."""

    link: Link
    received: list[tuple[float, Received]] = field(default_factory=list)
    broken: list[tuple[float, BrokenDeadline]] = field(default_factory=list)
    socket: list[bytes] = field(default_factory=list)
    socket_max: int = 10_000  # datagrams that the socket's buffer holds
    is_frozen: bool = False
    is_reading: bool = True  # False: the owner leaves its messages lying
    held_bytes_max: int = 0
    timer_calls: int = 0

    def bodies(self, service: Service) -> list[bytes]:
        return [r.body for _, r in self.received if r.service == service]

    def arrivals(self, service: Service) -> list[float]:
        return [t_s for t_s, r in self.received if r.service == service]


class LossyWire:
    """Two ends and the datagrams between them."""

    def __init__(
        self,
        seed: int,
        faults: Faults = PERFECT,
        *,
        limits: LinkLimits | None = None,
        drop=None,
    ) -> None:
        limits = limits or LinkLimits()
        self.random = random.Random(seed)
        self.faults = faults
        self.drop = drop or (lambda datagram, t_s: False)
        self.now_s = 1000.0
        self.agent = End(Link.for_agent(RUN_KEY, SESSION, 7, 99, limits=limits))
        self.host = End(host_link(RUN_KEY, SESSION, 7, 99, limits=limits))
        self.carried: list[tuple[float, bool, bytes]] = []
        self._events: list[tuple[float, int, object, bytes]] = []
        self._count = 0

    def _peer(self, end: End) -> End:
        return self.host if end is self.agent else self.agent

    def at(self, t_s: float, action) -> None:
        """Call *action* without arguments at a time."""
        self._push(t_s, action, b"")

    def _push(self, t_s: float, what: object, data: bytes) -> None:
        self._count += 1
        heapq.heappush(self._events, (t_s, self._count, what, data))

    def _carry(self, data: bytes, receiver: End) -> None:
        faults, chance = self.faults, self.random
        self.carried.append((self.now_s, receiver is self.host, data))
        if self.drop(data, self.now_s) or chance.random() < faults.loss:
            return
        copies = 2 if chance.random() < faults.duplication else 1
        for _ in range(copies):
            arriving = data
            if chance.random() < faults.corruption:
                flipped = bytearray(data)
                flipped[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
                arriving = bytes(flipped)
            delay_s = faults.delay_s + chance.random() * faults.jitter_s
            self._push(self.now_s + delay_s, receiver, arriving)

    def pump(self, end: End) -> None:
        """Let an end do what its owner's loop would do now."""
        if end.is_frozen:
            return
        link = end.link
        for data in end.socket:
            link.receive_datagram(data, self.now_s)
        end.socket.clear()
        timer_s = link.get_timer()
        if timer_s is not None and timer_s <= self.now_s:
            end.timer_calls += 1
            link.handle_timer(self.now_s)
        while end.is_reading and (message := link.next_message()) is not None:
            end.received.append((self.now_s, message))
        while (broken := link.next_broken_deadline()) is not None:
            end.broken.append((self.now_s, broken))
        end.held_bytes_max = max(end.held_bytes_max, link.held_bytes)
        for data in link.datagrams_to_send(self.now_s):
            self._carry(data, self._peer(end))
        # An owner that is told to come back at once when it has just been there would never sleep.
        timer_s = link.get_timer()
        assert timer_s is None or timer_s > self.now_s

    def _next_time(self) -> float | None:
        times = [self._events[0][0]] if self._events else []
        for end in (self.agent, self.host):
            timer_s = None if end.is_frozen else end.link.get_timer()
            if timer_s is not None:
                times.append(max(timer_s, self.now_s))
        return min(times, default=None)

    def run(self, until_s: float) -> None:
        """Let time pass until *until_s*, or until nothing is left to happen."""
        self.pump(self.agent)
        self.pump(self.host)
        while (t_s := self._next_time()) is not None and t_s <= until_s:
            self.now_s = t_s
            while self._events and self._events[0][0] <= t_s:
                _, _, what, data = heapq.heappop(self._events)
                if isinstance(what, End):
                    if len(what.socket) < what.socket_max:
                        what.socket.append(data)
                else:
                    what()
            self.pump(self.agent)
            self.pump(self.host)
        if t_s is not None:
            self.now_s = until_s

    def run_for(self, duration_s: float) -> None:
        self.run(self.now_s + duration_s)

    def send(self, end: End, body: bytes, service: Service, **options) -> None:
        end.link.send(body, service, self.now_s, **options)
