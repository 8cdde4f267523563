"""
Real time at scale: each claim with its goal, what was measured beside it in the same run, and whether it is met.

    python benchmarks/scale.py [--parts star,shapes,...] [--seconds 20] [--pairs 1] [--long 300] [--json]

The figures that README tells are of `--seconds 10 --pairs 5` and `--long 300`; `--pairs` are those of the part star. Parts:

    star           24 agents at 100 Hz: beside the bare star, in C, over ZeroMQ, and cyclictest with as many threads
    long           the same for --long seconds: each late tick with its cause
    shapes         93 x 100, 93 x 200, 240 x 20, 24 x 1000, 1000 x 10: missed, lost, start, real-time factor
    constellation  93 real satellites at 100 Hz that all maneuver, 1000 at 10 Hz: underruns of truth
    stress         24 x 100 beside 0, 2 and 4 processes that factorise primes
    bytes          what an agent tick takes on disk, and packed
    lockstep       a day of 93 satellites under control, and an hour of 1000

`python benchmarks/loss.py` is about networks that lose, `python benchmarks/soak.py` about hours.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shutil
import statistics
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from cosmos_runs import ROOT, cosmos_run, counter
from star import BARE, OURS, SECONDS_MIN, measure, median_of, print_table
from stars import FIFO_PRIORITY, Shape

SCENARIOS = ROOT / "scenarios"
STAR = Shape(24, 100)
SHAPES = {
    Shape(93, 100, 47): 1e-3,
    Shape(93, 200, 47): 1e-2,
    Shape(240, 20, 120): 1e-3,
    Shape(24, 1000, 12): 1e-3,
    Shape(1000, 10, 50): 1e-3,
}
"""Largest share of ticks that may be missed."""
MISSED_RATIO_LONG = 7 / 720_000
UNEXPLAINED_RATIO = 0.01
START_S = 20.0
RTF_TOLERANCE = 1e-3
LOCKSTEP = {"ring93": 1500.0, "starlink1000": 100.0}
"""Least speed, times real time."""


class Claim(NamedTuple):
    """One line of what is measured."""

    what: str
    got: float
    goal: float
    is_met: bool
    beside: str = ""


def at_most(what: str, got: float, goal: float, beside: str = "") -> Claim:
    """Return a claim that is met up to its goal."""
    return Claim(what, got, goal, got <= goal, beside)


def at_least(what: str, got: float, goal: float, beside: str = "") -> Claim:
    """Return a claim that is met from its goal on."""
    return Claim(what, got, goal, got >= goal, beside)


class Length(NamedTuple):
    """How long is measured."""

    seconds: float
    pairs: int
    long_s: float


# Parts --------------------------------------------------------------------------------------------


def star(length: Length) -> Iterator[Claim]:
    """Measure 24 agents at 100 Hz beside all rivals."""
    rivals = ["c", "zeromq"]
    pairs = [measure(STAR, length.seconds, rivals) for _ in range(length.pairs)]
    threads = cyclictest(STAR, length.seconds)
    medians = median_of(pairs)
    print_table({**STAR._asdict(), **medians})
    ours, zeromq = medians[OURS], medians["zeromq"]
    ratio = medians["ratio"]
    title = "24 x 100: "
    missed, bare_missed = (sum(pair[name]["missed"] for pair in pairs) for name in (OURS, BARE))
    yield at_most(f"{title}missed, of all pairs", missed, bare_missed, "the bare star's")
    yield at_most(f"{title}round trip p50, times the bare star", ratio["rtt_p50_us"], 1.3)
    yield at_most(f"{title}processor time, times the bare star", ratio["cpu_percent"], 2.0)
    for what, key in (
        ("round trip p50", "rtt_p50_us"),
        ("round trip p99", "rtt_p99_us"),
        ("lateness p50", "late_p50_us"),
        ("lateness p99", "late_p99_us"),
    ):
        yield at_most(f"{title}{what}, us", ours[key], zeromq[key], "ZeroMQ's")
    yield at_most(
        f"{title}lateness p99, us", ours["late_p99_us"], 2 * threads, "twice cyclictest's"
    )
    calls, waits = counts(Shape(24, 100, 24))
    yield at_most("24 x 100 in one process: returns of epoll_wait per pack and period", waits, 2)
    yield at_most("24 x 100 in one process: system calls per agent tick", calls, 4)
    yield at_most("24 x 100: recorded, bytes per agent tick", ours["bytes_per_tick"], 40)


def long(length: Length) -> Iterator[Claim]:
    """Measure 24 agents at 100 Hz for long, and account for each late tick."""
    with_causes = counter(STAR, length.long_s)
    causes: dict[str, int] = with_causes["causes"]  # type: ignore[assignment]
    print(f"\n24 x 100 for {length.long_s:g} s: missed {with_causes['missed']:g}", end="")
    print(f" of {with_causes['due']:g}, late {with_causes['late']:g}, causes {causes}")
    told = f"{with_causes['due']:g} ticks"
    title = f"24 x 100, {length.long_s:g} s: "
    missed = with_causes["missed"] - with_causes["missed_by_theft"]
    goal = math.ceil(MISSED_RATIO_LONG * with_causes["due"])
    yield at_most(f"{title}missed, without stolen time", missed, goal, told)
    every = with_causes["missed"] + with_causes["late"]
    unexplained = causes.get("unexplained", 0)
    yield at_most(f"{title}unexplained", unexplained, UNEXPLAINED_RATIO * every, "1 % of them")
    yield at_most(f"{title}messages lost", with_causes["messages_lost"], 0)


def shapes(length: Length) -> Iterator[Claim]:
    """Measure further shapes, each beside the bare star."""
    for shape, goal in SHAPES.items():
        pair = measure(shape, length.seconds)
        print_table({**shape._asdict(), **pair})
        ours, title = pair[OURS], f"{shape.agents} x {shape.hz} in {shape.processes} processes: "
        yield at_most(f"{title}missed", ours["missed_ratio"], goal, top_cause(ours))
        yield at_most(f"{title}messages lost", ours["messages_lost"], 0)
        yield at_most(f"{title}real-time factor off by", abs(ours["rtf"] - 1), RTF_TOLERANCE)
        yield at_most(f"{title}start, s", ours["start_s"], START_S, f"end {ours['end_s']:.1f} s")


def constellation(length: Length) -> Iterator[Claim]:
    """Measure real satellites that all maneuver at once."""
    seconds = max(20.0, length.seconds)
    burns = "parameters.flight.settings={commanded_s: 5, lead_s: 45}"
    for name, settings, least_s in (("planet93_100hz", (), 20.0), ("starlink1000", (burns,), 60.0)):
        duration = f"time.duration_s={max(seconds, least_s):g}"
        with cosmos_run(SCENARIOS / f"{name}.yaml", duration, *settings) as run:
            simulation, figures = run.result["simulation"], run.figures()
            maneuvers = simulation["host"]["maneuvers"]
            title = f"{name}, {maneuvers['executed']} maneuvers: "
            underruns = sum(agent["underruns"] for agent in simulation["agents"].values())
            yield at_most(f"{title}underruns", underruns, 0)
            yield at_most(f"{title}missed", figures["missed_ratio"], 1e-3, cause_of(run.result))
            yield at_most(f"{title}messages lost", figures["messages_lost"], 0)
            late = maneuvers["inequality_broken"]
            yield at_most(f"{title}late", late, 0, f"of {maneuvers['commanded']}")
            yield at_most(f"{title}start, s", run.start_s, START_S, f"end {run.end_s:.1f} s")


def stress(length: Length) -> Iterator[Claim]:
    """Measure 24 agents at 100 Hz beside processes that want all of the processors."""
    print(f"\n24 x 100 under stress, {length.seconds:g} s each")
    keys = ("missed", "late_p50_us", "late_p99_us", "rtt_p50_us", "rtt_p99_us")
    print(f"  {'workers':10}" + "".join(f"{key:>14}" for key in keys))
    for workers in (0, 2, 4):
        ours = counter(STAR, length.seconds, f"health.stress_workers={workers}")
        print(f"  {workers:<10}" + "".join(f"{ours[key]:14.0f}" for key in keys), flush=True)
        yield at_most(f"24 x 100, {workers} stress workers: missed", ours["missed_ratio"], 1e-3)


def size(length: Length) -> Iterator[Claim]:
    """Measure what an agent tick of ten satellites takes on disk."""
    with cosmos_run(
        SCENARIOS / "iridium10.yaml", f"time.duration_s={max(180.0, length.seconds)}"
    ) as run:
        figures = run.figures()
        yield at_most("iridium10: recorded, bytes per agent tick", figures["bytes_per_tick"], 125)
        packed = figures["packed_bytes_per_tick"]
        yield at_most("iridium10: packaged, bytes per agent tick", packed, 40)


def lockstep(length: Length) -> Iterator[Claim]:
    """Measure how many times faster than real time two constellations fly in lockstep."""
    hour = (
        "time.mode=lockstep",
        "time.duration_s=3600",
        "agents.tick_hz=1",
        "agents.per_process=1",
    )
    settings: dict[str, tuple[str, ...]] = {
        "ring93": (),
        "starlink1000": (
            *hour,
            "parameters.record.state_hz=0.01",
            "parameters.record.elements_hz=0.01",
            "parameters.flight.settings={commanded_s: 1e6, lead_s: 45}",
        ),
    }
    for name, goal in LOCKSTEP.items():
        with cosmos_run(SCENARIOS / f"{name}.yaml", *settings[name]) as run:
            figures = run.figures()
            told = f"start {run.start_s:.1f} s, end {figures['end_s']:.1f} s"
            yield at_least(f"{name} in lockstep: times real time", run.result["rtf"], goal, told)


PARTS = {
    "star": star,
    "long": long,
    "shapes": shapes,
    "constellation": constellation,
    "stress": stress,
    "bytes": size,
    "lockstep": lockstep,
}


# What parts share ---------------------------------------------------------------------------------


def top_cause(figures: dict[str, Any]) -> str:
    """Return the cause of most late ticks."""
    causes = figures["causes"]
    return f"most by {max(causes, key=causes.get)}" if causes else ""


def cause_of(result: dict[str, Any]) -> str:
    """Return the cause of most late ticks of a run."""
    return top_cause(result["timing"])


def counts(shape: Shape) -> tuple[float, float]:
    """
    Return system calls per agent tick, and returns of epoll_wait per pack and period, of one process.

    Between two runs of different lengths: what start and end take is in both. It differs by tens from run to run, so
    that the longer run is much longer.
    """
    (calls, waits), (more_calls, more_waits) = (
        calls_and_waits(shape, seconds) for seconds in (SECONDS_MIN, 5 * SECONDS_MIN)
    )
    periods = 4 * SECONDS_MIN * shape.hz
    return (
        (more_calls - calls) / (shape.agents * periods),
        (more_waits - waits) / (len(shape.packs()[0]) * periods),
    )


def calls_and_waits(shape: Shape, seconds: float) -> tuple[int, int]:
    """Return how many system calls and returns of epoll_wait one process took over a run."""
    text = (
        f"name: counts\nsimulation: counter\nagents: {{count: {shape.agents}, tick_hz: {shape.hz}, "
        f"per_process: {shape.per_process}}}\ntime: {{duration_s: {seconds}}}\n"
        "deadline: {max_miss_ratio: 1}\n"
    )
    with cosmos_run(text) as run:
        host = json.loads((run.directory / "host/result.json").read_bytes())
        records = next(iter(host["agents"].values()))["records"]
    loop, network = records["loop"], records["network"]
    calls = sum(loop.values()) + sum(network[k] for k in ("sent", "received", "empty_reads"))
    return calls, loop["waits"]


def cyclictest(shape: Shape, seconds: float) -> float:
    """Return the lateness p99, us, of cyclictest with as many threads; NaN where it is not installed."""
    program = shutil.which("cyclictest")
    if program is None:
        print("cyclictest (Debian: rt-tests) is not installed: nothing to compare lateness with")
        return math.nan
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "histogram")
        command = [
            program, "-q", "-m", f"-t{shape.agents}", f"-p{FIFO_PRIORITY}", f"-i{1_000_000 // shape.hz}",
            "-d0", f"-D{math.ceil(seconds)}", "-h20000", f"--histfile={path}",
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=seconds + 60)
        return percentile_99(path.read_text())


def percentile_99(histogram: str) -> float:
    """Return the value, us, up to which 99 % of a histogram of cyclictest lie; its columns are threads."""
    rows = re.findall(r"^(\d+)((?:[ \t]+\d+)+)[ \t]*$", histogram, flags=re.MULTILINE)
    counts = [(int(late_us), sum(map(int, numbers.split()))) for late_us, numbers in rows]
    wanted, seen = 0.99 * sum(number for _, number in counts), 0
    for late_us, number in counts:
        seen += number
        if seen >= wanted:
            return float(late_us)
    return math.nan


def main() -> None:
    """Measure the parts that are asked for, and print all claims."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", default=",".join(PARTS), help="which, comma-separated")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each measurement")
    parser.add_argument(
        "--pairs", type=int, default=1, help="pairs of the part star; medians count"
    )
    parser.add_argument("--long", type=float, default=300.0, help="length of the part long, s")
    parser.add_argument("--json", action="store_true", help="print the claims as JSON at the end")
    arguments = parser.parse_args()
    parts = arguments.parts.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"--parts: expected some of {','.join(PARTS)}, got {','.join(unknown)}")
    if not arguments.seconds >= SECONDS_MIN:
        parser.error(f"--seconds: expected at least {SECONDS_MIN:g}, got {arguments.seconds:g}")
    length = Length(arguments.seconds, arguments.pairs, arguments.long)
    claims = []
    for part in parts:
        for claim in PARTS[part](length):
            claims.append(claim)
            print_claim(claim)
    print("\nAll of it")
    for claim in claims:
        print_claim(claim)
    if arguments.json:
        print(json.dumps([claim._asdict() for claim in claims], indent=2))
    met = statistics.fmean(claim.is_met for claim in claims) if claims else 0.0
    print(f"{round(met * len(claims))} of {len(claims)} met")


def print_claim(claim: Claim) -> None:
    """Print one line."""
    state = "met" if claim.is_met else "NOT MET"
    beside = f"  ({claim.beside})" if claim.beside else ""
    print(
        f"  {claim.what:66}{claim.got:12.6g}  goal {claim.goal:<10.6g}{state}{beside}", flush=True
    )


if __name__ == "__main__":
    main()
