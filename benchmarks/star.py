"""
The counting benchmark beside bare echo stars of the same shape, measured in the same run.

    python benchmarks/star.py [--seconds 20] [--shapes 24x100,93x100/47] [--pairs 1] [--rivals c,tcp,zeromq] [--json]

A shape is agents x Hz, and how many agents share a process. The bare star is the least that Python can do: one echo
process, the same processes and packs of agents, no seal, no acknowledgement, no records, and one datagram per pack.
Rivals are the same star in C, over TCP, and over ZeroMQ (pip install pyzmq).
All stagger their packs, run under the same scheduling policy and alternate, so that what else the machine
does hits them all; of several pairs the median of each figure and of each ratio is told.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable, Sequence

from cosmos_runs import counter
from stars import Shape, bare_star, c_star

SECONDS_MIN = 8.0
"""A shorter run is over before its processes were watched."""
COUNTS = ("due", "missed", "lost")
BARE, OURS = "bare UDP", "cosmos"
RIVALS: dict[str, Callable[[Shape, float], dict[str, float]]] = {
    "c": c_star,
    "tcp": lambda shape, seconds: bare_star(shape, seconds, "tcp"),
    "zeromq": lambda shape, seconds: bare_star(shape, seconds, "zeromq"),
}
FIGURES = [
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
    parser.add_argument("--rivals", default="", help=f"some of {','.join(RIVALS)}")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    rivals = [name for name in arguments.rivals.split(",") if name]
    if unknown := set(rivals) - set(RIVALS):
        parser.error(f"--rivals: expected some of {','.join(RIVALS)}, got {','.join(unknown)}")
    if not arguments.seconds >= SECONDS_MIN:
        parser.error(f"--seconds: expected at least {SECONDS_MIN:g}, got {arguments.seconds:g}")
    rows = []
    for shape in arguments.shapes:
        pairs = [measure(shape, arguments.seconds, rivals) for _ in range(arguments.pairs)]
        rows.append({**shape._asdict(), **median_of(pairs)})
        if not arguments.json:
            print_table(rows[-1])
    if arguments.json:
        print(json.dumps(rows, indent=2))


def shapes(text: str) -> list[Shape]:
    """Return what each comma-separated shape says."""
    found = []
    for shape in text.split(","):
        rate, _, per_process = shape.partition("/")
        agents, hz = rate.split("x")
        found.append(Shape(int(agents), int(hz), int(per_process or 1)))
    return found


def measure(
    shape: Shape, seconds: float, rivals: Sequence[str] = (), settings: Sequence[str] = ()
) -> dict[str, dict[str, float]]:
    """Return the figures of the bare star, of ours and of rivals, and the ratios of ours to the bare star's."""
    # Bare before and after, as long as ours together: the sum of their counts stands beside ours, and
    # the mean of everything else.
    before = bare_star(shape, seconds / 2)
    ours = counter(shape, seconds, *settings)
    after = bare_star(shape, seconds / 2)
    bare = {key: (before[key] + after[key]) / (1 if key in COUNTS else 2) for key in before}
    ratio = {key: ours[key] / value for key, value in bare.items() if value}
    others = {name: RIVALS[name](shape, seconds) for name in rivals}
    return {BARE: bare, OURS: ours, "ratio": ratio, **others}


def median_of(pairs: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the median of each figure; of the ratios, that of the pairs' own."""
    return {
        side: {
            key: statistics.median(pair[side][key] for pair in pairs if key in pair[side])
            for key, value in pairs[0][side].items()
            if isinstance(value, int | float)
        }
        for side in pairs[0]
    }


def print_table(row: dict) -> None:
    """Print all stars' figures, and the ratio of ours to the bare star's."""
    names = [BARE, OURS, "ratio", *(name for name in RIVALS if name in row)]
    how = f"{row['per_process']} per process"
    print(f"\n{row['agents']} agents, {row['hz']} Hz, {how}")
    print(f"  {'':28}" + "".join(f"{name:>12}" for name in names))
    for label, key in FIGURES:
        cells = [
            f"{row[name][key]:12.{2 if name == 'ratio' else 1}f}"
            if key in row[name]
            else f"{'':>12}"
            for name in names
        ]
        print(f"  {label:28}" + "".join(cells), flush=True)


if __name__ == "__main__":
    main()
