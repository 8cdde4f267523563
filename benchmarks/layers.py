"""
Where the round trip of a star goes: the bare star, and the same with one layer of ours after the other.

    python benchmarks/layers.py [--seconds 10] [--rounds 3] [--json]

Each layer is added to those before it, at both ends of 24 agents at 100 Hz, one process each:

    bare      benchmarks/stars.py: blocking calls, and a datagram that nobody looks into
    loop      waits by epoll, and wakes up by a timer of the kernel's: many sockets and timers could share the wait
    messages  the datagram is a message by msgpack, made and read at both ends
    seal      header and message bear a MAC (keyed BLAKE2b) in both directions: nobody else can speak
    cosmos    the product: acknowledgements, clock, three services, plug-ins' calls, records of each tick

The stars alternate; of several rounds the median is told, and of processor time the whole.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import statistics
import tempfile
import time
from pathlib import Path

import msgpack
import numpy as np
from cosmos_runs import counter
from stars import (
    LINGER_S,
    WARM_UP_S,
    Pace,
    Shape,
    bare_star,
    cpu_of,
    figures_of,
    fork,
    newest_due,
    save,
)

from madns_runtime.protocol.datagram import HEADER_REST, MAC_BYTES, LinkKeys, Role, Seal
from madns_runtime.reactor import libc

SHAPE = Shape(24, 100)
LAYERS = ("loop", "messages", "seal")
BYTES = 64
REST = bytes(HEADER_REST.size)
FIGURES = ("rtt_p50_us", "rtt_p99_us", "late_p50_us", "late_p99_us", "cpu_percent")


def main() -> None:
    """Measure every layer and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each measurement")
    parser.add_argument("--rounds", type=int, default=3, help="measurements per layer")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    rounds = [measure(arguments.seconds) for _ in range(arguments.rounds)]
    medians = {
        name: {key: statistics.median(one[name][key] for one in rounds) for key in FIGURES}
        for name in rounds[0]
    }
    if arguments.json:
        print(json.dumps(medians, indent=2))
        return
    print(f"{SHAPE.agents} agents, {SHAPE.hz} Hz, one process each")
    print(f"  {'':10}" + "".join(f"{key:>14}" for key in FIGURES) + f"{'rtt p50 ratio':>16}")
    for name, figures in medians.items():
        ratio = figures["rtt_p50_us"] / medians["bare"]["rtt_p50_us"]
        row = "".join(f"{figures[key]:14.0f}" for key in FIGURES)
        print(f"  {name:10}{row}{ratio:16.2f}")


def measure(seconds: float) -> dict[str, dict[str, float]]:
    """Return the figures of each star, one run of each."""
    figures = {"bare": bare_star(SHAPE, seconds)}
    for number, name in enumerate(LAYERS):
        figures[name] = layered_star(LAYERS[: number + 1], seconds)
    return {**figures, "cosmos": counter(SHAPE, seconds)}


class Layered:
    """One end's way from a tick's number to a datagram and back, by the layers that it has."""

    def __init__(self, layers: tuple[str, ...], role: Role, agent: int) -> None:
        self._has_messages = "messages" in layers
        keys = LinkKeys(up=b"u" * 32, down=b"d" * 32)
        self._seal = None
        if "seal" in layers:
            self._seal = Seal(
                keys, role, session=b"starstar", agent_index=agent, incarnation_id=agent
            )
        self._pack, self._unpack = msgpack.Packer().pack, msgpack.unpackb

    def write(self, number: int) -> bytes:
        """Return the datagram of a tick."""
        payload = (
            self._pack(["count", number, 0.0])
            if self._has_messages
            else number.to_bytes(8, "little").ljust(BYTES, b"\0")
        )
        return payload if self._seal is None else self._seal.close(REST, payload)

    def read(self, datagram: bytes) -> int | None:
        """Return the tick's number; None of what does not come from the other end."""
        if self._seal is not None:
            if self._seal.find_fault(datagram) is not None:
                return None
            datagram = datagram[len(self._seal.prefix) + len(REST) : -MAC_BYTES]
        if self._has_messages:
            return int(self._unpack(datagram)[1])
        return int.from_bytes(datagram[:8], "little")


def layered_star(layers: tuple[str, ...], seconds: float) -> dict[str, float]:
    """Run a star of some layers; return its figures."""
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", 0))
    address = server.getsockname()
    phases = [packs[0][1] for packs in SHAPE.packs()]
    with tempfile.TemporaryDirectory() as folder:
        pace = Pace(time.monotonic() + WARM_UP_S + 0.1, SHAPE.hz, round(seconds * SHAPE.hz))
        end_s = pace.t0_s + seconds + LINGER_S
        pids = [fork(lambda: save(Path(folder, "host"), lambda: echo(server, layers, end_s)))]
        server.close()
        for number, phase_s in enumerate(phases, start=1):
            pids.append(
                fork(
                    lambda n=number, p=phase_s: save(
                        Path(folder, str(n)), lambda: ping(address, layers, n, (pace, p))
                    )
                )
            )
        if any(os.waitpid(pid, 0)[1] for pid in pids):
            raise SystemExit("a process of the star failed")
        host = float(np.load(Path(folder, "host.npz"))["cpu_s"])
        loaded = [np.load(Path(folder, f"{n}.npz")) for n in range(1, len(phases) + 1)]
        return {
            **figures_of(
                SHAPE.agents * pace.ticks,
                np.concatenate([one["rtt_us"] for one in loaded]),
                np.concatenate([one["late_us"] for one in loaded]),
            ),
            **cpu_of(seconds, host, sum(float(one["cpu_s"]) for one in loaded)),
        }


def echo(server: socket.socket, layers: tuple[str, ...], end_s: float) -> None:
    """Answer every message in its sender's own words."""
    server.setblocking(False)
    poller = select.epoll()
    poller.register(server, select.EPOLLIN)
    ends: dict[tuple[str, int], Layered] = {}
    while time.monotonic() < end_s:
        for _ in poller.poll(0.2):
            try:
                datagram, address = server.recvfrom(2048)
            except BlockingIOError:
                continue
            end = ends.get(address)
            if end is None:
                end = ends[address] = Layered(layers, Role.HOST, agent_of(datagram, layers))
            number = end.read(datagram)
            if number is not None:
                server.sendto(end.write(number), address)


def agent_of(datagram: bytes, layers: tuple[str, ...]) -> int:
    """Return the agent that a sealed datagram says it is of; 1 of all others."""
    return int.from_bytes(datagram[2:4], "little") if "seal" in layers else 1


def ping(
    address: tuple[str, int], layers: tuple[str, ...], agent: int, when: tuple[Pace, float]
) -> dict[str, list[float]]:
    """Send one message per tick, at its deadline, and time its return."""
    (t0_s, hz, ticks), phase_s = when
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect(address)
    client.setblocking(False)
    timer, setting = libc.timerfd_create(), libc.Itimerspec()
    poller, end = select.epoll(), Layered(layers, Role.AGENT, agent)
    poller.register(client, select.EPOLLIN)
    poller.register(timer, select.EPOLLIN)
    sent_s: dict[int, float] = {}
    round_trips: list[float] = []
    lateness: list[float] = []
    number, until_s = 0, t0_s + ticks / hz + LINGER_S

    def arm() -> None:
        due_s = t0_s + phase_s + number / hz if number < ticks else until_s
        setting.it_value.tv_sec, setting.it_value.tv_nsec = int(due_s), int(due_s % 1.0 * 1e9)
        libc.timerfd_settime(timer, setting)

    arm()
    while time.monotonic() < until_s:
        for fd, _ in poller.poll(LINGER_S):
            if fd == timer:
                os.read(timer, 8)
                begun_s = time.monotonic()
                number = newest_due(number, begun_s - t0_s - phase_s, hz)
                if number < ticks:
                    lateness.append(1e6 * (begun_s - t0_s - phase_s - number / hz))
                    sent_s[number] = begun_s
                    client.send(end.write(number))
                number += 1
                arm()
            else:
                answered = end.read(client.recv(2048))
                if answered is not None and answered in sent_s:
                    round_trips.append(1e6 * (time.monotonic() - sent_s.pop(answered)))
    return {"rtt_us": round_trips, "late_us": lateness}


if __name__ == "__main__":
    main()
