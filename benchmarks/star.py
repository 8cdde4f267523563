"""
The counting benchmark beside a bare UDP echo star of the same shape, measured in the same run.

    python benchmarks/star.py [--seconds 20] [--shapes 24x100,93x100/47] [--pairs 1] [--json]

A shape is agents x Hz, and how many agents share a process. The bare star is the least that Python can do: one echo
process, the same processes and packs of agents, no seal, no acknowledgement, no records, and one datagram per pack.
Both stars stagger their packs, run under the same scheduling policy and alternate, so that what else the machine
does hits both; of several pairs the median of each figure and of each ratio is told.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import os
import resource
import select
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from madns_runtime.health.probe import pss_bytes
from madns_runtime.processes import list_processes
from madns_runtime.realtime.packs import split_into_packs

PACKET = struct.Struct("<IId")
PACKET_BYTES = 64
RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
FIFO_PRIORITY = 10
BUDGET_BROKEN = 4
"""The exit code of a run that missed too many ticks, which is what is measured here."""
SECONDS_MIN = 4.0
"""A shorter run is over before its processes were watched."""
COUNTS = ("due", "missed", "lost")
ROOT = Path(__file__).parents[1]


def main() -> None:
    """Measure every shape and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each measurement")
    parser.add_argument(
        "--shapes",
        type=shapes,
        default="24x100,93x100/47",
        help="agents x Hz / agents per process, comma-separated",
    )
    parser.add_argument("--pairs", type=int, default=1, help="measurements per shape")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    if not arguments.seconds >= SECONDS_MIN:
        parser.error(f"--seconds: expected at least {SECONDS_MIN:g}, got {arguments.seconds:g}")
    rows = []
    for shape in arguments.shapes:
        pairs = [measure(shape, arguments.seconds) for _ in range(arguments.pairs)]
        rows.append({**shape._asdict(), **median_of(pairs)})
    if arguments.json:
        print(json.dumps(rows, indent=2))
    else:
        print_table(rows)


class Shape(NamedTuple):
    """What is measured."""

    agents: int
    hz: int
    per_process: int

    @property
    def processes(self) -> int:
        """How many processes the agents take."""
        return math.ceil(self.agents / self.per_process)


def shapes(text: str) -> list[Shape]:
    """Return what each comma-separated shape says."""
    found = []
    for shape in text.split(","):
        rate, _, per_process = shape.partition("/")
        agents, hz = rate.split("x")
        found.append(Shape(int(agents), int(hz), int(per_process or 1)))
    return found


def measure(shape: Shape, seconds: float) -> dict[str, dict[str, float]]:
    """Return the figures of both stars, and their ratios."""
    # Bare before and after, as long as ours together: the sum of their counts stands beside ours, and
    # the mean of everything else.
    before = bare_star(shape, seconds / 2)
    ours = cosmos_star(shape, seconds)
    after = bare_star(shape, seconds / 2)
    bare = {key: (before[key] + after[key]) / (1 if key in COUNTS else 2) for key in before}
    ratio = {key: ours[key] / value for key, value in bare.items() if value}
    return {"bare": bare, "cosmos": ours, "ratio": ratio}


def median_of(pairs: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the median of each figure; of the ratios, that of the pairs' own."""
    return {
        side: {
            key: statistics.median(pair[side][key] for pair in pairs if key in pair[side])
            for key in pairs[0][side]
        }
        for side in pairs[0]
    }


def print_table(rows: list[dict]) -> None:
    """Print both stars' figures and their ratios."""
    figures = [
        ("round trip p50, us", "rtt_p50_us"),
        ("round trip p99, us", "rtt_p99_us"),
        ("lateness p50, us", "late_p50_us"),
        ("lateness p99, us", "late_p99_us"),
        ("ticks due", "due"),
        ("ticks missed", "missed"),
        ("packets lost", "lost"),
        ("host CPU, % of a core", "host_cpu_percent"),
        ("all agents' CPU, %", "agents_cpu_percent"),
        ("host's and agents' CPU, %", "cpu_percent"),
        ("process's memory, MB PSS", "agent_pss_mb"),
        ("recorded, B per agent tick", "bytes_per_tick"),
    ]
    for row in rows:
        print(f"\n{row['agents']} agents, {row['hz']} Hz, {row['per_process']} per process")
        print(f"  {'':28}{'bare UDP':>12}{'cosmos':>12}{'ratio':>8}")
        for label, key in figures:
            bare, ours = row["bare"].get(key), row["cosmos"].get(key)
            ratio = f"{row['ratio'][key]:8.2f}" if key in row["ratio"] else ""
            left = f"{bare:12.1f}" if bare is not None else f"{'-':>12}"
            right = f"{ours:12.1f}" if ours is not None else f"{'-':>12}"
            print(f"  {label:28}{left}{right}{ratio}")


# The bare star ------------------------------------------------------------------------------------


def bare_star(shape: Shape, seconds: float) -> dict[str, float]:
    """Run one echo process and the pinging ones; return their figures."""
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    server.bind(("127.0.0.1", 0))
    address = server.getsockname()
    processes = [
        min(shape.per_process, shape.agents - first)
        for first in range(0, shape.agents, shape.per_process)
    ]
    packs = [packs_of(size) for size in processes]
    phases = iter(np.arange(sum(map(len, packs))) / sum(map(len, packs)) / shape.hz)
    with tempfile.TemporaryDirectory() as directory:
        t0_s = time.monotonic() + 0.5
        echo = fork(lambda: echo_until(server, t0_s + seconds + 0.5, Path(directory, "host")))
        server.close()
        children = [
            fork(
                lambda i=i, own=own: bare_agents(
                    address,
                    (t0_s, shape.hz, int(seconds * shape.hz)),
                    own,
                    Path(directory, str(i)),
                )
            )
            for i, own in enumerate([[(size, next(phases)) for size in sizes] for sizes in packs])
        ]
        time.sleep(max(0.0, t0_s + seconds * 0.7 - time.monotonic()))
        pss = [pss_bytes(pid) for pid in children]
        for pid in (*children, echo):
            os.waitpid(pid, 0)
        loaded = [np.load(Path(directory, f"{i}.npz")) for i in range(len(children))]
        round_trips = np.concatenate([one["rtt_us"] for one in loaded])
        lateness = np.concatenate([one["late_us"] for one in loaded])
        host_cpu_s = float(np.load(Path(directory, "host.npz"))["cpu_s"])
        agents_cpu_s = sum(float(one["cpu_s"]) for one in loaded)
    due = shape.agents * int(seconds * shape.hz)
    return {
        "rtt_p50_us": float(np.percentile(round_trips, 50)),
        "rtt_p99_us": float(np.percentile(round_trips, 99)),
        "late_p50_us": float(np.percentile(lateness, 50)),
        "late_p99_us": float(np.percentile(lateness, 99)),
        "due": due,
        "missed": due - len(lateness),
        "lost": len(lateness) - len(round_trips),
        "host_cpu_percent": 100 * host_cpu_s / seconds,
        "agents_cpu_percent": 100 * agents_cpu_s / seconds,
        "cpu_percent": 100 * (host_cpu_s + agents_cpu_s) / seconds,
        "agent_pss_mb": statistics.fmean(p for p in pss if p) / 1e6,
    }


def packs_of(agents: int) -> list[int]:
    """Return the sizes of a process's packs."""
    return [len(pack) for pack in split_into_packs(["agent"] * agents)]


def fork(work: Callable[[], None]) -> int:
    """Run *work* in a child with the policy that an agent's loop has; return its pid."""
    pid = os.fork()
    if pid:
        return pid
    try:
        take_fifo()
        work()
    finally:
        os._exit(0)


def take_fifo() -> None:
    """Ask for SCHED_FIFO, as agents do."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except PermissionError:
        return


def echo_until(server: socket.socket, end_s: float, path: Path) -> None:
    """Return every datagram to its sender."""
    server.settimeout(0.2)
    while time.monotonic() < end_s:
        try:
            data, address = server.recvfrom(2048)
        except TimeoutError:
            continue
        server.sendto(data, address)
    np.savez(path, cpu_s=cpu_seconds())


def bare_agents(
    address: tuple[str, int],
    pace: tuple[float, int, int],
    packs: list[tuple[int, float]],
    path: Path,
) -> None:
    """Send one datagram per pack and tick on absolute deadlines, and time its return for each agent of the pack."""
    t0_s, hz, ticks = pace
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect(address)
    client.setblocking(False)
    due = [(t0_s + phase_s, number, 0) for number, (_, phase_s) in enumerate(packs)]
    heapq.heapify(due)
    sent_s: dict[tuple[int, int], float] = {}
    round_trips: list[float] = []
    lateness: list[float] = []

    def take() -> None:
        while True:
            try:
                data = client.recv(2048)
            except BlockingIOError:
                return
            number, k, at_s = PACKET.unpack_from(data)
            if sent_s.pop((number, k), None) is not None:
                round_trips.extend([1e6 * (time.monotonic() - at_s)] * packs[number][0])

    while due:
        deadline_s, number, k = due[0]
        wait_s = deadline_s - time.monotonic()
        if wait_s > 0:
            if not sent_s:
                time.sleep(wait_s)
            elif select.select([client], [], [], wait_s)[0]:
                take()
            continue
        size, phase_s = packs[number]
        begun_s = time.monotonic()
        lateness.extend([1e6 * (begun_s - deadline_s)] * size)
        sent_s[number, k] = begun_s
        client.send(PACKET.pack(number, k, begun_s).ljust(PACKET_BYTES * size, b"\0"))
        # Whole periods overslept are missed.
        k = max(k + 1, int((time.monotonic() - t0_s - phase_s) * hz))
        if k < ticks:
            heapq.heapreplace(due, (t0_s + phase_s + k / hz, number, k))
        else:
            heapq.heappop(due)
    if sent_s and select.select([client], [], [], 0.1)[0]:
        take()
    np.savez(path, rtt_us=round_trips, late_us=lateness, cpu_s=cpu_seconds())


def cpu_seconds() -> float:
    """Return the CPU time of this process."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


# Ours ---------------------------------------------------------------------------------------------


def cosmos_star(shape: Shape, seconds: float) -> dict[str, float]:
    """Run the counter simulation through `cosmos run`; return its figures."""
    with tempfile.TemporaryDirectory(prefix="cosmos-star-") as directory:
        return run_cosmos(Path(directory), shape, seconds)


def run_cosmos(directory: Path, shape: Shape, seconds: float) -> dict[str, float]:
    """Run it in *directory*, and return the figures of what it left there."""
    environment = {**os.environ, "COSMOS_STATE_DIR": str(directory / "state")}
    scenario = directory / "star.yaml"
    scenario.write_text(
        f"name: star\nsimulation: counter\nagents: "
        f"{{count: {shape.agents}, tick_hz: {shape.hz}, per_process: {shape.per_process}}}\n"
        f"time: {{duration_s: {seconds}}}\nhealth: {{period_s: 5}}\n"
        "deadline: {max_miss_ratio: 1}\n",
        encoding="utf-8",
    )
    command = [
        sys.executable, "-m", "cosmos_cli.app", "run", str(scenario),
        "--runs", str(directory / "runs"), "--json", "--quiet", "--no-report",
    ]  # fmt: skip
    run = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, cwd=ROOT)
    os.environ["COSMOS_STATE_DIR"] = environment["COSMOS_STATE_DIR"]
    cpu, pss = watch(run, seconds)
    output = run.communicate(timeout=120)[0]
    if run.returncode not in (0, BUDGET_BROKEN):
        raise SystemExit(f"cosmos run ended with exit code {run.returncode}: no figures")
    result = json.loads(output)
    evidence = directory / "runs" / result["run"]
    ticks = [np.array(read_records(p)) for p in evidence.glob("agents/*/ticks.jsonl")]
    trips = [np.array(read_records(p)) for p in evidence.glob("agents/*/round_trips.jsonl")]
    lateness = np.concatenate([t[:, 1] for t in ticks])
    round_trips = np.concatenate([t[:, 2] for t in trips])
    recorded = sum(p.stat().st_size for p in evidence.glob("agents/**/*.jsonl"))
    return {
        "rtt_p50_us": float(np.percentile(round_trips, 50)),
        "rtt_p99_us": float(np.percentile(round_trips, 99)),
        "late_p50_us": float(np.percentile(lateness, 50)),
        "late_p99_us": float(np.percentile(lateness, 99)),
        "due": shape.agents * int(seconds * shape.hz),
        "missed": result["timing"]["missed"],
        "lost": len(lateness) - len(round_trips),
        "host_cpu_percent": cpu["host"],
        "agents_cpu_percent": cpu["agent"],
        "cpu_percent": cpu["host"] + cpu["agent"],
        "agent_pss_mb": pss / 1e6,
        "bytes_per_tick": recorded / len(lateness),
    }


def read_records(path: Path) -> list[list[float]]:
    """Return a stream's records without its first and last line."""
    with path.open("rb") as lines:
        return [json.loads(line) for line in lines if line.startswith(b"[")]


def watch(run: subprocess.Popen, seconds: float) -> tuple[dict[str, float], float]:
    """Sample CPU over the middle of the run, and memory near its end."""
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s:
        roles = [p.role for p in list_processes()]
        if "host" in roles and "agent" in roles:
            break
        time.sleep(0.2)
    time.sleep(1.0 + 0.1 * seconds)
    processes = list_processes()
    first, began_s = {p.pid: process_cpu_s(p.pid) for p in processes}, time.monotonic()
    time.sleep(0.5 * seconds)
    spent_s = time.monotonic() - began_s
    cpu = {"host": 0.0, "agent": 0.0}
    for process in processes:
        if process.role in cpu:
            used_s = process_cpu_s(process.pid) - first[process.pid]
            cpu[process.role] += 100 * used_s / spent_s
    pss = [pss_bytes(p.pid) for p in processes if p.role == "agent"]
    return cpu, statistics.fmean(p for p in pss if p)


def process_cpu_s(pid: int) -> float:
    """Return the CPU time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
