"""Runs, terminals and processes of the benchmark of devices."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

HZ = 100
FIFO_PRIORITY = 10
JUDGED = (0, 4)
"""Exit codes of a run with figures; 4: it missed ticks or had stale samples, which is what is measured here."""
START_S = 120.0
"""For a run to begin and to end, beside its own time."""
ROOT = Path(__file__).parents[1]

PLUGIN = '''
import time
from dataclasses import dataclass, replace

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample
from madns_runtime.hardware.kinds import serial
from madns_runtime.plugin.api import AgentSimulation, Simulation
from madns_runtime.recording.records import Field

READ_S = 0.5
WAIT_S = 0.02


@dataclass(frozen=True, kw_only=True)
class Parameters:
    mode: str = "none"


class Slow(Device):
    """Takes half a second for each read."""

    kind = DeviceKind(name="slow", summary="a slow read", needs_hardware=False, channels=(Channel(name="time"),))

    def read(self):
        time.sleep(READ_S)
        taken_s = time.monotonic()  # taken at its start it would be 1 s old before the next, and the device lost
        return Sample(values={"time": taken_s}, taken_s=taken_s)


line = replace(serial.kind, name="line", needs_hardware=False)  # the shipped driver, one per agent


class Reader(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        self.look = getattr(self, context.parameters.mode)
        self.sent = 0
        context.open_stream("looks", (Field("age_us", "us"), Field("number", "")))

    def step(self, tick):
        found = self.look(tick)
        if found is not None:
            self.context.record("looks", found)

    def none(self, tick):
        return None

    def inline(self, tick):
        time.sleep(READ_S)
        taken_s = time.monotonic()  # as in the device's process: at the end of the read
        return (time.monotonic() - taken_s) * 1e6, tick.index

    def slow(self, tick):
        reading = self.context.hardware["slow"]["time"]
        return (reading.age_s * 1e6, reading.number) if reading.number else None

    def many(self, tick):
        frames = self.context.hardware["line"].frames("received")
        return (frames[-1].age_s * 1e6, frames[-1].number) if frames else None

    def echo(self, tick):
        line = self.context.hardware["line"]
        line.frames("received")
        if line.status != "lost":
            line.write("sent", b"%d" % tick.index, due_s=tick.t_s + 0.005)

    def trip(self, tick):
        line = self.context.hardware["line"]
        line.frames("received")  # what came too late for the tick before
        began_s = time.monotonic()
        line.write("sent", b"%d" % tick.index)
        while (passed_s := time.monotonic() - began_s) < WAIT_S:
            if any(frame.value == b"%d" % tick.index for frame in line.frames("received")):
                return (time.monotonic() - began_s) * 1e6, tick.index
            time.sleep(2e-5)
        return None


simulation = Simulation(name="reader", parameters=Parameters, agent=":Reader")
'''


# Runs ---------------------------------------------------------------------------------------------


def device(kind: str, name: str, parameters: dict[str, Any], *, agent: str = "*") -> dict[str, Any]:
    """Return a device of a scenario, at 100 Hz."""
    described = {"name": name, "kind": kind, "rate_hz": HZ, "parameters": parameters}
    return {**described, "agents": [agent]}


@contextlib.contextmanager
def recorded_run(
    seconds: float, mode: str, devices: list[dict[str, Any]], *, agents: int = 1
) -> Iterator[Path]:
    """Run agents with devices through `cosmos run`, and give the folder that it left."""
    with tempfile.TemporaryDirectory(prefix="cosmos-hardware-") as folder:
        directory = Path(folder)
        (directory / "reader.py").write_text(PLUGIN, encoding="utf-8")
        hardware = {"armed": True, "on_device_loss": "continue", "devices": devices}
        scenario = {
            "name": "reader",
            "simulation": "./reader.py:simulation",
            "agents": {"count": agents, "tick_hz": HZ},
            "time": {"duration_s": seconds},
            "deadline": {"max_miss_ratio": 1},
            "parameters": {"mode": mode},
            **({"hardware": hardware} if devices else {}),
        }
        (directory / "reader.yaml").write_text(json.dumps(scenario), encoding="utf-8")
        yield run_scenario(directory, seconds)


def run_scenario(directory: Path, seconds: float) -> Path:
    """Run it, and return its folder."""
    command = [
        sys.executable, "-m", "cosmos_cli.start", "run", str(directory / "reader.yaml"),
        "--runs", str(directory / "runs"), "--json", "--quiet", "--no-report",
    ]  # fmt: skip
    environment = {**os.environ, "COSMOS_STATE_DIR": str(directory / "state")}
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    run = subprocess.run(
        command, stdout=subprocess.PIPE, env=environment, timeout=seconds + START_S, check=False
    )
    if run.returncode not in JUDGED:
        raise SystemExit(f"cosmos run ended with exit code {run.returncode}: no figures")
    return directory / "runs" / json.loads(run.stdout)["run"]


def tick_figures(run: Path) -> dict[str, float]:
    """Return how ticks were kept, over all agents."""
    result = json.loads((run / "run.json").read_text(encoding="utf-8"))
    timing = result["timing"]
    lateness_us = records(run, "agents/*/ticks.jsonl")[:, 1]
    missed = timing["missed"]
    return {
        "missed ticks": missed,
        "missed ratio": missed / (missed + len(lateness_us)),
        "lateness p50, us": float(np.percentile(lateness_us, 50)),
        "lateness p99, us": float(np.percentile(lateness_us, 99)),
    }


def records(run: Path, pattern: str, fields: tuple[int, ...] | None = None) -> np.ndarray:
    """Return the records of all streams of a pattern, as rows, of some fields if given."""
    rows = [record for path in sorted(run.glob(pattern)) for record in read_records(path)]
    if not rows:
        raise SystemExit(f"the run recorded nothing in {pattern}: no figures")
    return np.array(rows if fields is None else [[row[field] for field in fields] for row in rows])


def read_records(path: Path) -> list[list[Any]]:
    """Return a stream's records without its first and last line."""
    with path.open("rb") as lines:
        return [json.loads(line) for line in lines if line.startswith(b"[")]


# Terminals and processes --------------------------------------------------------------------------


@contextlib.contextmanager
def terminals(count: int) -> Iterator[list[tuple[int, str]]]:
    """Open pseudo-terminals; give our ends and the names of the others."""
    pairs = [os.openpty() for _ in range(count)]
    try:
        for master, slave in pairs:
            tty.setraw(slave)
            os.set_blocking(master, False)
        yield [(master, os.ttyname(slave)) for master, slave in pairs]
    finally:
        for pair in pairs:
            for fd in pair:
                os.close(fd)


@contextlib.contextmanager
def child(work: Callable[[], None]) -> Iterator[None]:
    """Run *work* in a process until the block ends."""
    pid = fork(work)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def fork(work: Callable[[], None]) -> int:
    """Run *work* in a child with the policy that the loops of agents and devices have; return its pid."""
    pid = os.fork()
    if pid:
        return pid
    try:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        work()
    finally:
        os._exit(0)
