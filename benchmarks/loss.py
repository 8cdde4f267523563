"""
Loss and burst: the counting benchmark, the same star over TCP and over ZeroMQ, on a network that loses packets.

    python benchmarks/loss.py [--agents 24] [--hz 100] [--seconds 20] [--loss 0,1,5] [--burst 240x10/24] [--json]

Needs root on Linux, and nft: all runs in a network namespace of its own whose loopback loses each packet with a given
probability, whole packets as a network does (segmentation offload is switched off). Best-effort messages of ours that
are lost stay lost and are counted; TCP and ZeroMQ send them again, and all that follows waits. `reliable` is ours with
delivery guaranteed.

The burst: all agents send at one instant, in each period, with the receive buffer that the system gives by default and
with the one that a run asks for.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from cosmos_runs import counter
from star import SECONDS_MIN, shapes
from stars import Shape, bare_star

INSIDE = "COSMOS_LOSS_INSIDE"
PROGRAMS = ("unshare", "ip", "ethtool", "nft")
RMEM_DEFAULT = Path("/proc/sys/net/core/rmem_default")
RULES = """
flush ruleset
table inet loss {{
    chain input {{
        type filter hook input priority 0;
        {rule}
    }}
}}
"""
FIGURES = [
    ("rtt p50, us", "rtt_p50_us", 0),
    ("p99, us", "rtt_p99_us", 0),
    ("p99.9, us", "rtt_p999_us", 0),
    ("max, us", "rtt_max_us", 0),
    ("late p99, us", "late_p99_us", 0),
    ("missed", "missed", 0),
    ("not back", "lost", 0),
]


def main() -> None:
    """Measure in a namespace of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--agents", type=int, default=24)
    parser.add_argument("--hz", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each measurement")
    parser.add_argument("--loss", default="0,1,5", help="percentages of packets that are lost")
    parser.add_argument(
        "--burst", type=shapes, default="240x10/24", help="agents x Hz / per process"
    )
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    arguments = parser.parse_args()
    if not arguments.seconds >= SECONDS_MIN:
        parser.error(f"--seconds: expected at least {SECONDS_MIN:g}, got {arguments.seconds:g}")
    if os.geteuid():
        parser.error("needs root: a network namespace and nft")
    if absent := [program for program in PROGRAMS if shutil.which(program) is None]:
        parser.error(f"needs {', '.join(PROGRAMS)}; not installed: {', '.join(absent)}")
    if INSIDE not in os.environ:
        os.environ[INSIDE] = "1"
        raise SystemExit(subprocess.run(["unshare", "-n", sys.executable, *sys.argv]).returncode)
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    subprocess.run(["ethtool", "-K", "lo", "tso", "off", "gso", "off", "gro", "off"], check=True)
    shape = Shape(arguments.agents, arguments.hz)
    rows = list(losses(shape, arguments.seconds, [float(p) for p in arguments.loss.split(",")]))
    for burst in arguments.burst:
        rows += bursts(burst, arguments.seconds)
    if arguments.json:
        print(json.dumps(rows, indent=2))


def losses(
    shape: Shape, seconds: float, percentages: list[float]
) -> Iterator[dict[str, float | str]]:
    """Yield each contender's figures at each loss."""
    contenders: dict[str, Callable[[], dict[str, float]]] = {
        "cosmos": lambda: counter(shape, seconds),
        "cosmos reliable": lambda: counter(shape, seconds, "parameters.service=reliable"),
        "bare UDP": lambda: bare_star(shape, seconds),
        "TCP": lambda: bare_star(shape, seconds, "tcp"),
        "ZeroMQ": lambda: bare_star(shape, seconds, "zeromq"),
    }
    for percent in percentages:
        lose(percent)
        print_head(f"{shape.agents} agents, {shape.hz} Hz, {percent:g} % lost on each way")
        for name, measure in contenders.items():
            yield told({"loss_percent": percent, "who": name, **measure()})
    lose(0)


def bursts(shape: Shape, seconds: float) -> Iterator[dict[str, float | str]]:
    """Yield the figures of all agents sending at one instant, with the default receive buffer and with ours."""
    aligned = shape._replace(aligned=True)
    print_head(
        f"{shape.agents} agents at one instant, {shape.hz} Hz, {shape.per_process} per process"
    )
    for buffer_bytes in (int(RMEM_DEFAULT.read_text()), aligned.receive_buffer_bytes):
        one = aligned._replace(receive_buffer_bytes=buffer_bytes)
        who = f"cosmos, {buffer_bytes // 1024} KiB"
        yield told({"who": who, **counter(one, seconds)})
        yield told({"who": f"bare UDP, {buffer_bytes // 1024} KiB", **bare_star(one, seconds)})
    for transport in ("tcp", "zeromq"):
        yield told({"who": transport, **bare_star(aligned, seconds, transport)})


def lose(percent: float) -> None:
    """Let the namespace's loopback lose so many of all packets that come in."""
    per_million = round(1e4 * percent)
    rule = f"meta l4proto {{ tcp, udp }} numgen random mod 1000000 < {per_million} drop"
    text = RULES.format(rule=rule if per_million else "")
    subprocess.run(["nft", "-f", "-"], input=text, text=True, check=True)


def print_head(title: str) -> None:
    """Print a table's head."""
    print(f"\n{title}", file=sys.stderr)
    cells = "".join(f"{label:>14}" for label, _, _ in FIGURES)
    print(f"  {'':20}{cells}{'RELIABLE lost':>15}", file=sys.stderr)


def told(row: dict[str, float | str]) -> dict[str, float | str]:
    """Print a row of a table, and return it."""
    cells = "".join(f"{row[key]:14.{digits}f}" for _, key, digits in FIGURES)
    print(
        f"  {row['who']:20}{cells}{row.get('reliable_lost', '')!s:>15}", file=sys.stderr, flush=True
    )
    return row


if __name__ == "__main__":
    main()
