"""
What expectations cost: a day of 93 satellites under control with twenty of them over all samples, and without.

    python benchmarks/expectations.py [--pairs 3] [--hours 24] [--state-hz 1] [--json]

Each pair is two whole commands, `cosmos run` with reading, judging and packing, one after the other; the order changes
from pair to pair. Told are processor time and wall time of each, and the median of the pairs' ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).parents[1]
SCENARIO = ROOT / "scenarios" / "ring93.yaml"
KINDS = (
    {"stream": "state", "field": "x_teme_m", "statistic": "rms", "below": 1e7},
    {"stream": "state", "field": "y_teme_m", "statistic": "p99", "below": 1e7},
    {"stream": "state", "field": "z_teme_m", "statistic": "max", "below": 1e7},
    {"stream": "state", "field": "vx_teme_m_s", "within": [-1e4, 1e4]},
    {"stream": "state", "field": "vy_teme_m_s", "statistic": "mean", "within": [-1e4, 1e4]},
    {"stream": "state", "statistic": "count", "above": 1},
    {
        "stream": "state",
        "field": "vz_teme_m_s",
        "while": {"stream": "estimates", "field": "slot_error_deg", "within": [-10, 10]},
        "within": [-1e4, 1e4],
    },
    {
        "stream": "estimates",
        "field": "slot_error_deg",
        "statistic": "settled",
        "when": {"within": [-10, 10]},
        "above": -1,
    },
    {"stream": "estimates", "field": "slot_error_deg", "at_end": True, "within": [-10, 10]},
    {"event": "action_refused", "must": "not_occur", "agents": ["*"]},
)
COUNT = 20
PATIENCE_S = 3600.0


class Cost(NamedTuple):
    """What one command took."""

    cpu_s: float
    wall_s: float


def main() -> None:
    """Run the pairs and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--state-hz", type=float, default=1.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    settings = (
        f"time.duration_s={options.hours * 3600:g}",
        f"parameters.record.state_hz={options.state_hz:g}",
    )
    pairs = [_pair(settings, is_reversed=number % 2 == 1) for number in range(options.pairs)]
    ratios = {
        name: statistics.median(
            getattr(judged, name) / getattr(bare, name) for bare, judged in pairs
        )
        for name in Cost._fields
    }
    if options.json:
        rows = [{"without": bare._asdict(), "with": judged._asdict()} for bare, judged in pairs]
        print(json.dumps({"pairs": rows, "ratios": ratios}))
        return
    print(f"{'':10}{'without':>20}{'with':>20}")
    for number, (bare, judged) in enumerate(pairs, 1):
        for name in Cost._fields:
            label = f"{number} {name}"
            print(f"{label:10}{getattr(bare, name):20.1f}{getattr(judged, name):20.1f}")
    print(f"with {COUNT} expectations: {ratios['cpu_s']:.3f} of the processor time, "
          f"{ratios['wall_s']:.3f} of the wall time (median of {len(pairs)} pairs)")  # fmt: skip


def expectations() -> list[dict[str, object]]:
    """Return the checks: each kind as often as it takes, under names of their own."""
    return [
        {"name": f"expectation{number}", **KINDS[number % len(KINDS)]} for number in range(COUNT)
    ]


def _pair(settings: tuple[str, ...], *, is_reversed: bool) -> tuple[Cost, Cost]:
    found: dict[bool, Cost] = {}
    for is_judged in (True, False) if is_reversed else (False, True):
        found[is_judged] = _run(settings, expectations() if is_judged else [])
    return found[False], found[True]


def _run(settings: tuple[str, ...], checks: list[dict[str, object]]) -> Cost:
    """Run the scenario with these checks to its end, and return what it took."""
    with tempfile.TemporaryDirectory(prefix="cosmos-benchmark-") as name:
        folder = Path(name)
        scenario = yaml.safe_load(SCENARIO.read_text("utf-8"))
        scenario["checks"] = checks
        scenario.pop("test", None)
        for part in ("data", "flight"):
            shutil.copytree(SCENARIO.parent / part, folder / part)
        (folder / "ring.yaml").write_text(yaml.safe_dump(scenario), "utf-8")
        command = [
            sys.executable, "-m", "cosmos_cli.start", "run", "ring.yaml", "--quiet",
            *(part for setting in settings for part in ("--set", setting)),
        ]  # fmt: skip
        environment = {**os.environ, "COSMOS_RUNS": name, "COSMOS_STATE_DIR": f"{name}/state"}
        before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False,
            timeout=PATIENCE_S,
        )  # fmt: skip
        wall_s, after = time.monotonic() - began_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        raise SystemExit(
            f"cosmos run ended with exit code {done.returncode}: {done.stderr[-2000:]}"
        )
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(cpu_s, wall_s)


if __name__ == "__main__":
    main()
