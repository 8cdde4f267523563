"""
Least lateness and least UDP round trip that a program of this kind can reach on a machine.

One process waits for absolute deadlines as the loops of runs do (epoll, with a timerfd in it), sends one
small datagram at each and times its return: from an echo process on the loopback of the same machine, or
from the operator's responder over the network. No seal, no acknowledgement, no records.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import math
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Mapping

from cosmos_cli.onboard.facts import is_preempt_rt
from cosmos_cli.onboard.request_loop import HelperRefusal, PlainValue, VerbRequest, verb
from cosmos_cli.onboard.udp_probe import ANSWER, ASK, Datagram

COUNT_MAX = 1_000_000
"""Ticks of one measurement: its samples are kept until its end."""
SEQUENCES = 65_536
"""Datagrams are told apart by 16 bits; more than these are never under way."""
PATIENCE_S = 10.0
LAST_ANSWER_S = 0.25
"""For the return of the last datagram."""
ANSWER_BYTES_MAX = 65_536
RECEIVE_BYTES = 2048
PLAIN_BYTES = 64
LOOPBACK = "127.0.0.1"
CLOCK_MONOTONIC = 1
TIMER_ABSOLUTE = 1
NON_BLOCKING = os.O_NONBLOCK
PR_SET_PDEATHSIG, PR_SET_TIMERSLACK = 1, 29
NANOSECONDS = 1_000_000_000


@verb("timing_floor")
def timing_floor(request: VerbRequest) -> dict[str, PlainValue]:
    """
    Measure at one rate, with or without SCHED_FIFO, in processes that end with this one.

    Args:
        request: "count" and "rate_hz" of ticks; "policy", normal or fifo, and "priority" (the echo process has one
            more); "link" (address, port, nonce_hex) for the operator's responder, null for loopback.

    Returns:
        "refusal", why there is no SCHED_FIFO: nothing was measured then; "due", "missed" ticks, "sent", "answered"
        datagrams, "lateness_us" and "round_trip_us" with p50, p99, p999, max (null without a sample),
        "is_preempt_rt", and "error" where the socket failed.
    """
    asked = request.arguments
    if not 1 <= asked["count"] <= COUNT_MAX:
        raise HelperRefusal("step", f"count: expected 1 to {COUNT_MAX}, got {asked['count']}")
    told: dict[str, PlainValue] = {"refusal": None, **_none_measured(), "error": None}
    told |= _in_child(lambda: _measure(asked), asked["count"] / asked["rate_hz"] + PATIENCE_S)
    return {**told, "is_preempt_rt": is_preempt_rt("/sys", "/proc")}


def _none_measured() -> dict[str, PlainValue]:
    counts = dict.fromkeys(("due", "missed", "sent", "answered"), 0)
    return {**counts, "lateness_us": None, "round_trip_us": None}


def _in_child(work: Callable[[], dict[str, PlainValue]], limit_s: float) -> dict[str, PlainValue]:
    """Do *work* in a process of its own, which is killed when the operator goes or the time is over."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            _die_with_parent()
            os.write(writing, json.dumps(work()).encode())
        finally:
            os._exit(0)
    os.close(writing)
    try:
        return _answer_of(reading, limit_s)
    finally:
        os.close(reading)
        _end(pid)


def _answer_of(reading: int, limit_s: float) -> dict[str, PlainValue]:
    waiting = select.poll()
    waiting.register(reading, select.POLLIN)
    waiting.register(0, 0)  # the operator's end of the connection: its closing is told unasked
    for fd, _ in waiting.poll(limit_s * 1e3):
        if fd == reading:
            return dict(json.loads(os.read(reading, ANSWER_BYTES_MAX) or b"{}")) or {
                "error": "the measuring process ended without a word"
            }
    return {"error": f"not done in {limit_s:g} s"}


def _measure(asked: Mapping[str, PlainValue]) -> dict[str, PlainValue]:
    link, priority = asked["link"], asked["priority"] if asked["policy"] == "fifo" else None
    echo_pid = 0
    try:
        with contextlib.ExitStack() as opened:
            if link is None:
                server = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                server.bind((LOOPBACK, 0))
                echo_pid = _fork_echo(server, None if priority is None else priority + 1)
                family, where = socket.AF_INET, server.getsockname()
            else:
                found = socket.getaddrinfo(link["address"], link["port"], type=socket.SOCK_DGRAM)
                family, where = found[0][0], found[0][4]
            client = opened.enter_context(socket.socket(family, socket.SOCK_DGRAM))
            client.connect(where)
            client.setblocking(False)
            refusal = _prepare(priority)
            if refusal is not None:
                return {"refusal": refusal}
            codec = _PlainCodec() if link is None else _ProbeCodec(bytes.fromhex(link["nonce_hex"]))
            return _Loop(client, codec).run(asked["count"], 1 / asked["rate_hz"])
    except OSError as error:
        return {"error": error.strerror or str(error)}
    finally:
        if echo_pid:
            _end(echo_pid)


class _PlainCodec:
    """Datagrams of the loopback: a number and nothing else."""

    def encode(self, sequence: int) -> bytes:
        return sequence.to_bytes(4, "big").ljust(PLAIN_BYTES, b"\0")

    def decode(self, data: bytes) -> int | None:
        return int.from_bytes(data[:4], "big") if len(data) == PLAIN_BYTES else None


class _ProbeCodec:
    """Datagrams that the operator's responder answers."""

    def __init__(self, nonce: bytes) -> None:
        self._nonce = nonce

    def encode(self, sequence: int) -> bytes:
        return Datagram(nonce=self._nonce, kind=ASK, sequence=sequence).encode()

    def decode(self, data: bytes) -> int | None:
        answer = Datagram.decode(data)
        is_ours = answer is not None and (answer.nonce, answer.kind) == (self._nonce, ANSWER)
        return answer.sequence if answer is not None and is_ours else None


class _Loop:
    """Ticks at absolute deadlines; between them answers are taken as they come."""

    def __init__(self, client: socket.socket, codec: _PlainCodec | _ProbeCodec) -> None:
        self._client = client
        self._codec = codec
        self._timer = _Timer()
        self._epoll = select.epoll()
        self._epoll.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._epoll.register(client.fileno(), select.EPOLLIN)
        self._under_way: dict[int | None, float] = {}
        """When each was sent, by number, s; none has None, which stands for what is no answer."""
        self._sent = 0
        self._lateness_s: list[float] = []
        self._trips_s: list[float] = []

    def run(self, count: int, period_s: float) -> dict[str, PlainValue]:
        """
        Tick *count* times, those that are missed included, and tell what came of it.

        As in runs, a tick that could not begin within its period is missed, and the newest due one begins.
        """
        start_s = time.monotonic() + period_s
        index = 0
        while index < count:
            self._wait(start_s + index * period_s)
            now_s = time.monotonic()
            index = max(index, int((now_s - start_s) / period_s))
            if index < count:
                self._lateness_s.append(now_s - start_s - index * period_s)
                self._send(index % SEQUENCES)
            index += 1
        end_s = time.monotonic() + LAST_ANSWER_S
        while self._under_way and time.monotonic() < end_s:
            self._wait(end_s, is_patient=False)
        return {
            "due": count,
            "missed": count - len(self._lateness_s),
            "sent": self._sent,
            "answered": len(self._trips_s),
            "lateness_us": _ranks_us(self._lateness_s),
            "round_trip_us": _ranks_us(self._trips_s),
        }

    def _send(self, sequence: int) -> None:
        self._under_way[sequence] = time.monotonic()
        with contextlib.suppress(OSError):  # refused or unreachable: as good as no answer
            self._client.send(self._codec.encode(sequence))
        self._sent += 1

    def _wait(self, deadline_s: float, *, is_patient: bool = True) -> None:
        """Take answers until the deadline; without patience return after the first of them."""
        if time.monotonic() >= deadline_s:
            return
        self._timer.set(deadline_s)
        while True:
            for fd, _ in self._epoll.poll():
                if fd != self._timer.fd:
                    self._receive()
            if time.monotonic() >= deadline_s or not is_patient:
                return

    def _receive(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                data = self._client.recv(RECEIVE_BYTES)
                now_s = time.monotonic()
                sent_s = self._under_way.pop(self._codec.decode(data), None)
                if sent_s is not None:
                    self._trips_s.append(now_s - sent_s)


class _Timer:
    """A timerfd; before Python 3.13 by the C library."""

    def __init__(self) -> None:
        self._set_ns = getattr(os, "timerfd_settime_ns", None)
        if self._set_ns is not None:
            self.fd = int(getattr(os, "timerfd_create")(CLOCK_MONOTONIC, flags=NON_BLOCKING))  # noqa: B009 - since Python 3.13
            return
        self._libc = ctypes.CDLL(None, use_errno=True)
        self.fd = int(self._libc.timerfd_create(CLOCK_MONOTONIC, NON_BLOCKING))
        if self.fd < 0:
            raise OSError(ctypes.get_errno(), "no timerfd")
        self._when = (ctypes.c_long * 4)()  # struct itimerspec: interval, then value, each s and ns

    def set(self, when_s: float) -> None:
        when_ns = max(1, math.ceil(when_s * NANOSECONDS))
        if self._set_ns is not None:
            self._set_ns(self.fd, flags=TIMER_ABSOLUTE, initial=when_ns)
            return
        self._when[2], self._when[3] = divmod(when_ns, NANOSECONDS)
        self._libc.timerfd_settime(self.fd, TIMER_ABSOLUTE, ctypes.byref(self._when), None)


def _fork_echo(server: socket.socket, priority: int | None) -> int:
    """Start what returns every datagram, scheduled as a host would be; refused, it is what the asker is."""
    pid = os.fork()
    if pid:
        return pid
    try:
        _die_with_parent()
        _prepare(priority)
        waiting = select.epoll()
        waiting.register(server.fileno(), select.EPOLLIN)
        while True:
            waiting.poll()
            data, where = server.recvfrom(RECEIVE_BYTES)
            with contextlib.suppress(OSError):
                server.sendto(data, where)
    finally:
        os._exit(0)


def _prepare(priority: int | None) -> str | None:
    """Ask for what a loop of a run asks for; return why SCHED_FIFO was refused, None if it was not."""
    gc.disable()
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if priority is None:
        return None
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return getattr(error, "strerror", None) or "not known to this system"
    return None


def _die_with_parent() -> None:
    parent = os.getppid()
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != parent:
        os._exit(0)


def _end(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, 0)


def _ranks_us(values_s: list[float]) -> dict[str, PlainValue] | None:
    if not values_s:
        return None
    ordered = sorted(values_s)
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
    return {
        name: ordered[max(0, math.ceil(share * len(ordered)) - 1)] * 1e6
        for name, share in shares.items()
    }
