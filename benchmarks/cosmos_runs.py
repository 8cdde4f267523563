"""Runs of `cosmos run` by benchmarks: started, watched, and read."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stars import Shape, figures_of

from madns_runtime.health.probe import pss_bytes
from madns_runtime.processes import list_processes
from madns_runtime.timing.clock import utc_now_iso

ROOT = Path(__file__).parents[1]
BUDGET_BROKEN = 4
"""The exit code of a run that missed too many ticks, which is what is measured here."""
START_S_MAX = 180.0
END_S_MAX = 300.0


class CosmosRun(NamedTuple):
    """A run that is over."""

    result: dict[str, Any]
    """Its run.json."""
    directory: Path
    cpu: dict[str, float]
    """Processor time of host and agents in the middle of the run, % of a core."""
    pss_bytes: float
    """Memory of a process of agents, near the end."""
    start_s: float
    """From the command until simulated time began."""
    end_s: float
    """From the end of simulated time until the command returned: summaries, collecting, judging, packing."""

    def figures(self) -> dict[str, float]:
        """Return what every run has."""
        result, agents = self.result, self.directory / "agents"
        timing = result["timing"]
        ran = timing["ticks"] - timing["missed"]
        packed = next(iter(self.directory.parent.glob(f"{self.directory.name}*.tar.zst")), None)
        packed = packed or next(iter(self.directory.glob("*.tar.zst")), None)
        return {
            "missed_ratio": timing["missed"] / timing["ticks"],
            "host_cpu_percent": self.cpu["host"],
            "agents_cpu_percent": self.cpu["agent"],
            "cpu_percent": self.cpu["host"] + self.cpu["agent"],
            "agent_pss_mb": self.pss_bytes / 1e6,
            "bytes_per_tick": sum(p.stat().st_size for p in agents.rglob("*.jsonl")) / max(1, ran),
            "packed_bytes_per_tick": packed.stat().st_size / max(1, ran) if packed else np.nan,
            "start_s": self.start_s,
            "end_s": self.end_s,
            "rtf": result["rtf"],
            "messages_lost": sum(
                result["messages"][s]["lost"] for s in ("best", "reliable", "sync")
            ),
            "reliable_lost": result["messages"]["reliable"]["lost"],
        }


@contextmanager
def cosmos_run(scenario: str | Path, *settings: str) -> Iterator[CosmosRun]:
    """
    Run a scenario, and give what it left, which is gone afterwards.

    Args:
        scenario: File, or a scenario's text.
        settings: As of --set.
    """
    with tempfile.TemporaryDirectory(prefix="cosmos-benchmark-") as folder:
        directory = Path(folder)
        if isinstance(scenario, str):
            path = directory / "benchmark" / "benchmark.yaml"
            path.parent.mkdir()
            path.write_text(scenario, encoding="utf-8")
        else:
            path = scenario
        os.environ["COSMOS_STATE_DIR"] = str(directory / "state")
        command = [
            sys.executable, "-m", "cosmos_cli.app", "run", str(path), "--runs", str(directory / "runs"),
            "--json", "--quiet", "--no-report", *(part for one in settings for part in ("--set", one)),
        ]  # fmt: skip
        run = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT)
        began_s = wall_s(utc_now_iso())
        cpu, pss = watch(run)
        output = run.communicate(timeout=END_S_MAX)[0]
        if run.returncode not in (0, BUDGET_BROKEN):
            raise SystemExit(
                f"cosmos run ended with exit code {run.returncode}: {output[-2000:]!r}"
            )
        ended_s = wall_s(utc_now_iso())
        result = json.loads(output)
        t0_s = wall_s(result["t0_utc"])
        yield CosmosRun(
            result=result,
            directory=directory / "runs" / result["run"],
            cpu=cpu,
            pss_bytes=pss,
            start_s=t0_s - began_s,
            end_s=ended_s - t0_s - result["duration_s"] / (result["rtf"] or 1.0),
        )


def wall_s(utc_iso: str) -> float:
    """Return a time of records in seconds."""
    return datetime.fromisoformat(utc_iso).timestamp()


def counter(shape: Shape, seconds: float, *settings: str) -> dict[str, float]:
    """Run the counting benchmark; return its figures, and causes of late ticks under `causes`."""
    text = (
        f"name: star\nsimulation: counter\nagents: {{count: {shape.agents}, tick_hz: {shape.hz}, "
        f"per_process: {shape.per_process}, phase: {'aligned' if shape.aligned else 'staggered'}}}\n"
        f"time: {{duration_s: {seconds}}}\nhealth: {{period_s: 5}}\ndeadline: {{max_miss_ratio: 1}}\n"
        f"network: {{receive_buffer_bytes: {shape.receive_buffer_bytes}}}\n"
        "timeouts: {agents_ready_s: 120, agent_setup_s: 120}\n"
    )
    with cosmos_run(text, *settings) as run:
        agents = run.directory / "agents"
        lateness = read_column(agents.glob("*/ticks.jsonl"), 1)
        round_trips = read_column(agents.glob("*/round_trips.jsonl"), 2)
        timing = run.result["timing"]
        late = [row for path in agents.glob("*/late_ticks.jsonl") for row in read_rows(path)]
        return {
            **figures_of(timing["ticks"], round_trips, lateness),
            **run.figures(),
            "missed": timing["missed"],
            "missed_by_theft": sum(row[2] for row in late if row[3] == "stolen"),
            "late": timing["late"],
            "causes": timing["causes"],  # type: ignore[dict-item]
        }


def read_column(paths: Iterator[Path], column: int) -> np.ndarray:
    """Return one field of all records of some files."""
    return np.array([row[column] for path in paths for row in read_rows(path)], dtype=float)


def read_rows(path: Path) -> Iterator[list[Any]]:
    """Yield the records of a stream, without its first and last line."""
    with path.open("rb") as lines:
        yield from (json.loads(line) for line in lines if line.startswith(b"["))


def watch(run: subprocess.Popen[bytes]) -> tuple[dict[str, float], float]:
    """Sample CPU over the middle of a run until it ends, and memory while it lasts."""
    samples: list[tuple[float, dict[int, tuple[str, float]]]] = []
    pss: list[float] = []
    deadline_s = time.monotonic() + START_S_MAX
    while run.poll() is None and (samples or time.monotonic() < deadline_s):
        time.sleep(2.0)
        processes = [p for p in list_processes() if p.role in ("host", "agent")]
        if {p.role for p in processes} != {"host", "agent"}:
            if samples:
                break
            continue
        used = {
            p.pid: (p.role, cpu_s) for p in processes if (cpu_s := process_cpu_s(p.pid)) is not None
        }
        samples.append((time.monotonic(), used))
        if len(samples) == 2 or len(samples) % 30 == 0:
            pss = [size for p in processes if p.role == "agent" and (size := pss_bytes(p.pid))]
    # The first and the last samples see set-up and end.
    first, last = middle_of(samples)
    cpu = {"host": 0.0, "agent": 0.0}
    for pid, (role, used_s) in last[1].items():
        if pid in first[1]:
            cpu[role] += 100 * (used_s - first[1][pid][1]) / max(1e-9, last[0] - first[0])
    return cpu, statistics.fmean(pss) if pss else float("nan")


def middle_of(samples: Sequence[Any]) -> tuple[Any, Any]:
    """Return the samples that bound the middle of a run."""
    if len(samples) < 2:
        raise SystemExit("the run was over before it was watched: make it longer")
    edge = max(1, len(samples) // 4) if len(samples) > 3 else 0
    return samples[edge], samples[-1 - edge]


def process_cpu_s(pid: int) -> float | None:
    """Return the CPU time of a process so far; None if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
