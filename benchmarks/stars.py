"""
Stars with nothing in them: one echo process and agents that time the way there and back.

In Python over UDP, TCP or ZeroMQ, and in C over UDP (stars.c). Same processes, packs, phases, scheduling policy
and rule of missed ticks as a run's: no seal, no acknowledgement, no records, and one message per pack.
"""

from __future__ import annotations

import heapq
import math
import os
import shutil
import socket
import statistics
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from star_transports import TRANSPORTS, Client

from madns_runtime.health.probe import pss_bytes
from madns_runtime.timing.pack_split import split_into_packs
from madns_runtime.timing.rate import staggered

PACKET = struct.Struct("<IId")
PACKET_BYTES = 64
RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
FIFO_PRIORITY = 10
WARM_UP_S = 0.5
"""Between the start of the processes and the first tick."""
LINGER_S = 0.5
"""How long the echo, and agents that wait for answers, go on after the last tick."""
SOURCE = Path(__file__).with_suffix(".c")


class Shape(NamedTuple):
    """What is measured."""

    agents: int
    hz: int
    per_process: int = 1
    aligned: bool = False
    receive_buffer_bytes: int = RECEIVE_BUFFER_BYTES
    """Asked for by the host's socket."""

    @property
    def processes(self) -> int:
        """How many processes the agents take."""
        return math.ceil(self.agents / self.per_process)

    def packs(self) -> list[list[tuple[int, float]]]:
        """Return size and phase, s, of each pack, by process."""
        sizes = [
            [len(pack) for pack in split_into_packs(["agent"] * count)]
            for count in (
                min(self.per_process, self.agents - first)
                for first in range(0, self.agents, self.per_process)
            )
        ]
        phase, count = "aligned" if self.aligned else "staggered", sum(map(len, sizes))
        phases = iter(staggered(count, self.hz, phase=phase))
        return [[(size, next(phases)) for size in own] for own in sizes]


class Pace(NamedTuple):
    """When ticks are due."""

    t0_s: float
    hz: int
    ticks: int


def bare_star(shape: Shape, seconds: float, transport: str = "udp") -> dict[str, float]:
    """Run one echo process and the pinging ones; return their figures."""
    if transport == "zeromq" and find_spec("zmq") is None:
        raise SystemExit("the star over ZeroMQ needs pyzmq: pip install pyzmq")
    way, packs = TRANSPORTS[transport], shape.packs()
    server = socket.socket(socket.AF_INET, way.kind)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, shape.receive_buffer_bytes)
    server.bind(("127.0.0.1", 0))
    address = server.getsockname()
    if transport == "tcp":
        server.listen(1024)
    with tempfile.TemporaryDirectory() as directory:
        pace = Pace(
            time.monotonic() + WARM_UP_S + 0.004 * shape.processes,
            shape.hz,
            round(seconds * shape.hz),
        )
        end_s = pace.t0_s + seconds + LINGER_S
        echo = fork(lambda: save(Path(directory, "host"), lambda: way.echo(server, end_s)))
        server.close()
        children = [
            fork(
                lambda i=i, own=own: save(
                    Path(directory, str(i)), lambda: bare_agents(way.client(address), pace, own)
                )
            )
            for i, own in enumerate(packs)
        ]
        time.sleep(max(0.0, pace.t0_s + seconds * 0.7 - time.monotonic()))
        pss = [pss_bytes(pid) for pid in children]
        failed = [pid for pid in (*children, echo) if os.waitpid(pid, 0)[1] != 0]
        if failed:
            raise SystemExit(f"{len(failed)} processes of the star over {transport} failed")
        loaded = [np.load(Path(directory, f"{i}.npz")) for i in range(len(children))]
        return {
            **figures_of(
                shape.agents * pace.ticks,
                np.concatenate([one["rtt_us"] for one in loaded]),
                np.concatenate([one["late_us"] for one in loaded]),
            ),
            **cpu_of(
                seconds,
                float(np.load(Path(directory, "host.npz"))["cpu_s"]),
                sum(float(one["cpu_s"]) for one in loaded),
            ),
            "agent_pss_mb": statistics.fmean(p for p in pss if p) / 1e6,
        }


def figures_of(due: int, round_trips_us: np.ndarray, lateness_us: np.ndarray) -> dict[str, float]:
    """Return percentiles and counts of all ticks."""
    figures = {}
    for name, values in (("rtt", round_trips_us), ("late", lateness_us)):
        for percent in (50, 99, 99.9):
            key = f"{name}_p{str(percent).replace('.', '')}_us"
            figures[key] = float(np.percentile(values, percent)) if len(values) else math.nan
        figures[f"{name}_max_us"] = float(values.max(initial=0.0))
    lost = len(lateness_us) - len(round_trips_us)
    return {**figures, "due": due, "missed": due - len(lateness_us), "lost": lost}


def cpu_of(seconds: float, host_s: float, agents_s: float) -> dict[str, float]:
    """Return processor times as shares of one core, %."""
    return {
        "host_cpu_percent": 100 * host_s / seconds,
        "agents_cpu_percent": 100 * agents_s / seconds,
        "cpu_percent": 100 * (host_s + agents_s) / seconds,
    }


def fork(work: Callable[[], None]) -> int:
    """Run *work* in a child with the policy that an agent's loop has; return its pid."""
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        take_fifo()
        work()
        code = 0
    finally:
        os._exit(code)


def take_fifo() -> None:
    """Ask for SCHED_FIFO, as agents do."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except PermissionError:
        return


def save(path: Path, work: Callable[[], dict[str, list[float]] | None]) -> None:
    """Do *work*; keep what it returns and what it took of a processor, s, without the process's start and end."""
    before_s = time.process_time()
    figures = work() or {}
    np.savez(path, cpu_s=time.process_time() - before_s, **figures)


def newest_due(k: int, since_s: float, hz: int) -> int:
    """
    Return the tick to begin instead of the due one *k*, *since_s* after the first deadline, s; the number of ticks or more after the last.

    As in runs, a tick that could not begin within its period is missed, and the newest due one begins.
    """
    return max(k, int(since_s * hz))


def bare_agents(
    client: Client, pace: Pace, packs: list[tuple[int, float]]
) -> dict[str, list[float]]:
    """Send one message per pack and tick on absolute deadlines, and time its return for each agent of the pack."""
    t0_s, hz, ticks = pace
    due = [(t0_s + phase_s, number, 0) for number, (_, phase_s) in enumerate(packs)]
    heapq.heapify(due)
    sent_s: dict[tuple[int, int], float] = {}
    round_trips: list[float] = []
    lateness: list[float] = []

    def take() -> None:
        while (data := client.receive()) is not None:
            number, k, at_s = PACKET.unpack_from(data)
            if sent_s.pop((number, k), None) is not None:
                round_trips.extend([1e6 * (time.monotonic() - at_s)] * packs[number][0])

    while due:
        deadline_s, number, k = due[0]
        wait_s = deadline_s - time.monotonic()
        if wait_s > 0:
            if not sent_s:
                time.sleep(wait_s)
            elif client.wait(wait_s):
                take()
            continue
        size, phase_s = packs[number]
        begun_s, first_s = time.monotonic(), t0_s + phase_s
        k = newest_due(k, begun_s - first_s, hz)
        if k < ticks:
            lateness.extend([1e6 * (begun_s - first_s - k / hz)] * size)
            sent_s[number, k] = begun_s
            client.send(PACKET.pack(number, k, begun_s).ljust(PACKET_BYTES * size, b"\0"))
        if k + 1 < ticks:
            heapq.heapreplace(due, (first_s + (k + 1) / hz, number, k + 1))
        else:
            heapq.heappop(due)
        if len(sent_s) > 1000:
            del sent_s[next(iter(sent_s))]
    until_s = time.monotonic() + LINGER_S
    while sent_s and (wait_s := until_s - time.monotonic()) > 0:
        client.wait(wait_s)
        take()
    return {"rtt_us": round_trips, "late_us": lateness}


# In C ---------------------------------------------------------------------------------------------


def c_star(shape: Shape, seconds: float) -> dict[str, float]:
    """Compile and run stars.c; return its figures. It has one process per pack's process, too."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise SystemExit("the star in C needs a C compiler: cc is not installed")
    with tempfile.TemporaryDirectory() as directory:
        program = Path(directory, "star")
        subprocess.run([compiler, "-O2", "-o", program, SOURCE], check=True)
        lines = [
            " ".join([str(len(own)), *(f"{size} {phase_s:.9f}" for size, phase_s in own)])
            for own in shape.packs()
        ]
        arguments = [str(shape.hz), str(round(seconds * shape.hz)), str(FIFO_PRIORITY)]
        answer = subprocess.run(
            [program, *arguments, directory],
            input="\n".join([str(len(lines)), *lines]),
            text=True,
            capture_output=True,
            check=True,
            timeout=seconds + 60,
        )
        host_s, agents_s = map(float, answer.stdout.split())
        paths = sorted(Path(directory).glob("*.f64"))
        values = [np.fromfile(path).reshape(-1, 3) for path in paths]
    every = np.concatenate(values)
    sizes = every[:, 0].astype(int)
    came = every[:, 2] >= 0
    return {
        **figures_of(
            shape.agents * round(seconds * shape.hz),
            np.repeat(every[came, 2], sizes[came]),
            np.repeat(every[:, 1], sizes),
        ),
        **cpu_of(seconds, host_s, agents_s),
    }
