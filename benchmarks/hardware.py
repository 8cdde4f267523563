"""
Devices beside the agents' ticks: what reading them costs, side by side with what it costs without the framework.

    python benchmarks/hardware.py [--seconds 8] [--pairs 5] [--agents 24] [--only slow,many,echo,trip,port] [--json]

slow: a read of 500 ms at 100 Hz, none, in line with the agent's step (as in the thesis), and by a device's process.
many: agents at 100 Hz with a serial line each, on a pseudo-terminal that a feeder writes at 100 Hz, and without.
echo: from the time at which a device's output is due to the time at which its echo is taken, and the bare terminal.
trip: from an agent's write over its device and an echo back to the agent, in the same tick.
port: what an agent's look at a channel takes, and the framework's look at the devices in each tick.

Runs alternate, so that what else the machine does hits all; the figure is the median of the pairs, and the
machine's load stands beside each.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hardware_runs import (  # of this folder
    HZ,
    child,
    device,
    fork,
    read_records,
    recorded_run,
    records,
    terminals,
    tick_figures,
)

from madns_runtime.hardware import messages, page
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.port import DevicePort, Hardware
from madns_runtime.hardware.status import StatusLimits

LOOKS = 20_000


def main() -> None:
    """Measure what is asked for and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--seconds", type=float, default=8.0, help="length of each run")
    parser.add_argument("--pairs", type=int, default=5, help="interleaved pairs per figure")
    parser.add_argument("--agents", type=int, default=24, help="agents with a serial line each")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, comma-separated")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    parts = arguments.only.split(",")
    if unknown := [part for part in parts if part not in PARTS]:
        parser.error(f"--only: expected some of {', '.join(PARTS)}; got {', '.join(unknown)}")
    if arguments.seconds < 2 or arguments.pairs < 1 or arguments.agents < 1:
        parser.error("expected --seconds of at least 2, and at least one pair and agent")
    rows = [row for part in parts for row in PARTS[part](arguments)]
    if arguments.json:
        print(json.dumps(rows, indent=2))
    else:
        print_table(rows)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print a line per measurement, with the figures of each pair and their median."""
    for row in rows:
        print(f"\n{row['part']}: {row['what']}   (load {', '.join(map(str, row['load']))})")
        for name, values in row["figures"].items():
            each = "  ".join(f"{value:.4g}" for value in values)
            print(f"  {name:32}{statistics.median(values):12.4g}   [{each}]")


class Rows:
    """Figures of several measurements of a part, over the pairs."""

    def __init__(self, part: str) -> None:
        self._part = part
        self._rows: dict[str, dict[str, Any]] = {}

    def add(self, what: str, figures: dict[str, float]) -> None:
        """Add one pair's figures of a measurement, with the machine's load."""
        row = self._rows.setdefault(
            what, {"part": self._part, "what": what, "load": [], "figures": {}}
        )
        row["load"].append(load())
        for name, value in figures.items():
            row["figures"].setdefault(name, []).append(value)

    def all(self) -> list[dict[str, Any]]:
        """Return the rows, each with its medians."""
        for row in self._rows.values():
            row["median"] = {
                name: statistics.median(values) for name, values in row["figures"].items()
            }
        return list(self._rows.values())


def load() -> float:
    """Return the processes that were ready to run, on average over a minute."""
    return float(Path("/proc/loadavg").read_text().split()[0])


# A slow read --------------------------------------------------------------------------------------


def slow_read(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Compare no read, one in the step, and one in a device's process."""
    rows = Rows("slow")
    for _ in range(arguments.pairs):
        for what, mode, devices in (
            ("no device", "none", []),
            ("500 ms in line with the step", "inline", []),
            ("500 ms in a device's process", "slow", [device("./reader.py:Slow", "slow", {})]),
        ):
            with recorded_run(arguments.seconds, mode, devices) as run:
                figures = tick_figures(run)
                if mode != "none":
                    ages_us = records(run, "agents/*/looks.jsonl")[:, 0]
                    figures["age since its read, p50, ms"] = float(np.percentile(ages_us, 50)) / 1e3
                    figures["age since its read, max, ms"] = float(ages_us.max()) / 1e3
                rows.add(what, figures)
    return rows.all()


# Many lines ---------------------------------------------------------------------------------------


def many_lines(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Compare many agents with a serial line each to the same agents without."""
    rows = Rows("many")
    count = arguments.agents
    for _ in range(arguments.pairs):
        with recorded_run(arguments.seconds, "none", [], agents=count) as run:
            rows.add(f"{count} agents, no device", tick_figures(run))
        with terminals(count) as lines, child(lambda lines=lines: feed(lines)):
            devices = [
                device("./reader.py:line", "line", {"port": port}, agent=f"agent-{number:02}")
                for number, (_, port) in enumerate(lines, 1)
            ]
            with recorded_run(arguments.seconds, "many", devices, agents=count) as run:
                rates = [
                    frame_rate(path, arguments.seconds)
                    for path in run.glob("devices/*/line/received.jsonl")
                ]
                assert len(rates) == count, f"{len(rates)} of {count} lines have records"
                figures = {"slowest line, ratio of its rate": min(rates)}
                rows.add(f"{count} agents, a line each", {**tick_figures(run), **figures})
    return rows.all()


def frame_rate(path: Path, seconds: float) -> float:
    """Return how many frames a line gave, by how many it was fed, over the middle of a run."""
    begin_s, end_s = 0.5, seconds - 0.5
    t_s = np.array([record[0] for record in read_records(path)])
    return float(np.count_nonzero((t_s >= begin_s) & (t_s < end_s))) / ((end_s - begin_s) * HZ)


def feed(lines: list[tuple[int, str]]) -> None:
    """Write a frame into each terminal at 100 Hz, each at its own time within the period."""
    begin_s = time.monotonic()
    number = 0
    while True:
        due_s = begin_s + number / len(lines) / HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
        with contextlib.suppress(BlockingIOError):  # nobody reads yet, or any more
            os.write(lines[number % len(lines)][0], b"%08d\n" % number)
        number += 1


# Echoes -------------------------------------------------------------------------------------------


def line_echo(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Compare the time from due to taken in a device's process to the bare terminal's."""
    rows = Rows("echo")
    for _ in range(arguments.pairs):
        with terminals(1) as lines, child(lambda lines=lines: echo(lines)):
            port = lines[0][1]
            rows.add("bare terminal", percentiles(bare_echo(port, arguments.seconds)))
            with recorded_run(arguments.seconds, "echo", [echoing(port)]) as run:
                sent = records(run, "devices/*/line/sent.jsonl", (0, 3))
                taken = records(run, "devices/*/line/received.jsonl", (0, 4))
                taken_s = {bytes.fromhex(data): float(t_s) for t_s, data in taken}
                passed_us = [
                    1e6 * (taken_s[frame] - float(due_s))
                    for due_s, data in sent
                    if (frame := bytes.fromhex(data)) in taken_s
                ]
                late = {"not echoed": float(len(sent) - len(passed_us))}
                rows.add("a device's process", {**percentiles(np.array(passed_us)), **late})
    return rows.all()


def round_trip(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Time an agent's write until it has its echo."""
    rows = Rows("trip")
    for _ in range(arguments.pairs):
        with terminals(1) as lines, child(lambda lines=lines: echo(lines)):
            port = lines[0][1]
            with recorded_run(arguments.seconds, "trip", [echoing(port)]) as run:
                trips_us = records(run, "agents/*/looks.jsonl")[:, 0]
                lost = {"not back in 20 ms": arguments.seconds * HZ - len(trips_us)}
                rows.add("agent, device, agent", {**percentiles(trips_us), **lost})
    return rows.all()


def percentiles(passed_us: np.ndarray) -> dict[str, float]:
    """Return the figures of times, us."""
    p50, p99 = np.percentile(passed_us, (50, 99))
    return {"p50, us": float(p50), "p99, us": float(p99)}


def echoing(port: str) -> dict[str, Any]:
    """Return the serial line of the one agent there."""
    return device("./reader.py:line", "line", {"port": port})


def echo(lines: list[tuple[int, str]]) -> None:
    """Return all bytes to their sender."""
    poll = select.poll()
    for fd, _ in lines:
        poll.register(fd, select.POLLIN)
    while True:
        for fd, _ in poll.poll():
            with contextlib.suppress(BlockingIOError):
                os.write(fd, os.read(fd, 4096))


def bare_echo(port: str, seconds: float) -> np.ndarray:
    """Return the times from due to taken of the least that Python can do, in a process of its own, us."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "echo.npy")
        pid = fork(lambda: ping(port, seconds, path))
        os.waitpid(pid, 0)
        return np.load(path)


def ping(port: str, seconds: float, path: Path) -> None:
    """Write a frame at 100 Hz and wait for its echo."""
    fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
    passed_us = []
    begin_s = time.monotonic() + 0.1
    for number in range(int(seconds * HZ)):
        due_s = begin_s + number / HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
        os.write(fd, b"%d\n" % number)
        data = b""
        while not data.endswith(b"\n"):
            data += os.read(fd, 4096)
        passed_us.append(1e6 * (time.monotonic() - due_s))
    np.save(path, passed_us)


# An agent's look ----------------------------------------------------------------------------------


def port_looks(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Time an agent's look at a vector of three, and the framework's look at one device."""
    rows = Rows("port")
    channel = Channel(name="gyro", unit="rad/s", shape=(3,))
    shared = DevicePage([channel])
    end, other = messages.make_pair()
    limits = StatusLimits.of(0.01, 15.0)
    hardware = Hardware({"imu": DevicePort("imu", (channel,), shared=(shared, end), limits=limits)})
    shared.header[page.STATE] = page.OPEN
    for _ in range(arguments.pairs):
        now_s = time.monotonic()
        shared.header[page.NEWEST_S] = now_s
        shared.write("gyro", now_s, now_s, (0.1, 0.2, 0.3))
        figures = {
            'context.hardware["imu"]["gyro"], us': each_us(lambda: hardware["imu"]["gyro"]),
            "look at one device per tick, us": each_us(hardware.changes),
        }
        rows.add("an agent", figures)
    end.close()
    other.close()
    return rows.all()


def each_us(call: Callable[[], object]) -> float:
    """Return the processor's time of one call, us."""
    began_s = time.process_time()
    for _ in range(LOOKS):
        call()
    return 1e6 * (time.process_time() - began_s) / LOOKS


PARTS: dict[str, Callable[[argparse.Namespace], list[dict[str, Any]]]] = {
    "slow": slow_read,
    "many": many_lines,
    "echo": line_echo,
    "trip": round_trip,
    "port": port_looks,
}

if __name__ == "__main__":
    main()
