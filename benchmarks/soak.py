"""
A long run: lateness, memory, open files and records over time, and whether they stay flat.

    python benchmarks/soak.py [--minutes 30] [--agents 24] [--hz 100] [--per-process 1] [--windows 6] [--json]

Flat: the median of no window, of those after the first, lies more than 10 % and a floor above that of the second:
what grows with time would. Percentiles of lateness are of each window by itself; a busy machine shows in them.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cosmos_runs import BUDGET_BROKEN, ROOT, START_S_MAX, read_column
from stars import Shape

from madns_runtime.health.probe import pss_bytes
from madns_runtime.processes import list_processes

FLAT = 1.10
SAMPLE_INTERVAL_S = 5.0
WINDOWS_MIN = 3


class Sample(NamedTuple):
    """What all processes of host and agents have at a moment."""

    at_s: float
    memory_mb: float
    open_files: float
    recorded_bytes: float


class Figure(NamedTuple):
    """One row of the table."""

    label: str
    values: list[float]
    floor: float
    """A difference that is none."""

    def is_flat(self) -> bool:
        """Return whether no later window lies above the second."""
        reference = self.values[1]
        return all(value <= FLAT * reference + self.floor for value in self.values[2:])


def main() -> None:
    """Run, sample, and print a table of windows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--agents", type=int, default=24)
    parser.add_argument("--hz", type=int, default=100)
    parser.add_argument("--per-process", type=int, default=1)
    parser.add_argument("--windows", type=int, default=6, help="parts of the run to compare")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    if arguments.windows < WINDOWS_MIN or arguments.minutes * 60 < 10 * arguments.windows:
        parser.error(f"expected at least {WINDOWS_MIN} windows of 10 s")
    shape = Shape(arguments.agents, arguments.hz, arguments.per_process)
    with tempfile.TemporaryDirectory(prefix="cosmos-soak-") as folder:
        samples, evidence = soak(Path(folder), shape, arguments.minutes * 60)
        figures = tabulate(samples, evidence, arguments.windows, shape)
        result = json.loads((evidence / "run.json").read_bytes())
    print(f"{shape.agents} agents, {shape.hz} Hz, {arguments.minutes:g} min, by window")
    for figure in figures:
        cells = "".join(f"{value:12.1f}" for value in figure.values)
        print(f"  {figure.label:34}{cells}  {'flat' if figure.is_flat() else 'NOT FLAT'}")
    timing, messages = result["timing"], result["messages"]
    lost = sum(messages[service]["lost"] for service in ("best", "reliable", "sync"))
    print(
        f"  missed {timing['missed']} of {timing['ticks']}, causes {timing['causes']}, {lost} messages lost"
    )
    if arguments.json:
        print(json.dumps([figure._asdict() for figure in figures], indent=2))


def soak(directory: Path, shape: Shape, seconds: float) -> tuple[list[Sample], Path]:
    """Run for so long; return what was sampled, and the run's folder."""
    os.environ["COSMOS_STATE_DIR"] = str(directory / "state")
    scenario = directory / "scenario" / "soak.yaml"
    scenario.parent.mkdir()
    scenario.write_text(
        f"name: soak\nsimulation: counter\nagents: {{count: {shape.agents}, tick_hz: {shape.hz}, "
        f"per_process: {shape.per_process}}}\ntime: {{duration_s: {seconds}}}\ndeadline: {{max_miss_ratio: 1}}\n",
        encoding="utf-8",
    )
    command = [
        sys.executable, "-m", "cosmos_cli.app", "run", str(scenario), "--runs", str(directory / "runs"),
        "--json", "--quiet", "--no-report",
    ]  # fmt: skip
    samples: list[Sample] = []
    began_s = time.monotonic()
    run = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT)
    while run.poll() is None and time.monotonic() - began_s < seconds + START_S_MAX:
        sample = take_sample(directory, processes=shape.processes + 1)
        if sample is not None:
            samples.append(sample)
        elif len(samples) > 1:
            break
        time.sleep(min(SAMPLE_INTERVAL_S, seconds / 60))
    output = run.communicate(timeout=600)[0]
    if run.returncode not in (0, BUDGET_BROKEN):
        raise SystemExit(f"cosmos run ended with exit code {run.returncode}: {output[-2000:]!r}")
    return samples, directory / "runs" / json.loads(output)["run"]


def take_sample(directory: Path, *, processes: int) -> Sample | None:
    """Return what all processes have; None while not all live."""
    pids = [p.pid for p in list_processes() if p.role in ("host", "agent")]
    if len(pids) < processes:
        return None
    try:
        memory = sum(pss_bytes(pid) or 0 for pid in pids)
        files = sum(len(os.listdir(f"/proc/{pid}/fd")) for pid in pids)
    except OSError:
        return None
    recorded = sum(path.stat().st_size for path in directory.glob("runs/*/agents/**/*.jsonl"))
    return Sample(time.monotonic(), memory / 1e6, files, recorded)


def tabulate(samples: Sequence[Sample], evidence: Path, windows: int, shape: Shape) -> list[Figure]:
    """Return the figures by window."""
    paths = list(evidence.glob("agents/*/ticks.jsonl"))
    index, lateness = (read_column(iter(paths), column) for column in (0, 1))
    edges = np.linspace(0, index.max() + 1, windows + 1)
    parts = [
        lateness[(index >= low) & (index < high)]
        for low, high in zip(edges, edges[1:], strict=False)
    ]
    groups = [list(group) for group in np.array_split(np.array(samples), windows)]
    rates = [
        (group[-1][3] - group[0][3]) / (group[-1][0] - group[0][0]) / (shape.agents * shape.hz)
        for group in groups
    ]
    return [
        Figure("lateness p50, us", [float(np.percentile(part, 50)) for part in parts], 20.0),
        Figure("lateness p99.9, us", [float(np.percentile(part, 99.9)) for part in parts], 200.0),
        Figure("memory of all, MB PSS", [float(np.median([s[1] for s in g])) for g in groups], 0.5),
        Figure("open files of all", [float(np.median([s[2] for s in g])) for g in groups], 0.0),
        Figure("recorded, B per agent tick", rates, 0.5),
    ]


if __name__ == "__main__":
    main()
