"""
Two hundred faults of twenty kinds, inserted on purpose, and what became of the runs.

    python benchmarks/faults.py [--each 10] [--kinds kill,hang] [--seed 1] [-i INVENTORY] [--json]

Each kind is one run of twelve agents in real time, on loopback or on the machines of an inventory (such as a virtual
tower's, where signals go by `cosmos exec`), with one fault of it after the other. A fault is survived if it took effect (ticks left out,
long steps, messages lost, late or doubled), the run is complete and nobody is lost whom no fault named; named if the host's events, or its verdict, say whom it befell; the seconds until then are of the
run's own events. Bytes unaccounted are those of record files that neither the manifest nor a loss that is named
explains. A run that has not ended in time is a hang; a process of it that lives on, or a file half written, is a
leftover. The exit code is 1 if any fault was not survived or not named, or any of the last three
is not 0.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from agent_processes import COSMOS, BoardProcesses, LocalProcesses

ROOT = Path(__file__).parents[1]
SIMULATION = ROOT / "tests/harness/fault_simulation.py"
AGENTS = 12
"""Two of them are never touched: a run that has lost everybody ends."""
TICK_HZ = 10
FIRST_S, EVERY_S, FOR_S = 2.0, 1.5, 1.0
EVERY_ON_BOARDS_S = 3.0
"""Between signals that are sent by a login."""
AFTER_S = 6.0
"""From the last fault to the end of a run: whoever was ended is back."""
PATIENCE_S = 120.0
"""Beyond its length a run that has not ended hangs."""
COMPLETE = (0, 4, 5)
"""Exit codes of runs that came to their end."""
LOST = "lost"
ALTERED = ("lost", "late", "doubled", "double_discarded")
"""Counts under `faults` of messages that a fault has altered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultKind:
    """One kind of faults: an action of the timeline, or something done to an agent's process from outside."""

    name: str
    action: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    for_s: float | None = FOR_S
    per_process: int = 1
    number: signal.Signals | None = None
    """The signal that the agent's process gets, where it is not the timeline's affair."""
    is_loss: bool = False
    """Whether the agent is lost by it."""


KINDS = (
    FaultKind(name="kill", action="kill", for_s=None, is_loss=True),
    FaultKind(name="kill and return", action="kill", is_loss=True),
    FaultKind(name="kill one of five in a process", action="kill", per_process=5, is_loss=True),
    FaultKind(name="restart", action="restart", for_s=None, is_loss=True),
    FaultKind(name="hang", action="hang"),
    FaultKind(name="slow", action="slow", parameters={"factor": 1000}),  # of a step of some 50 us
    FaultKind(name="lose all messages", action="lose_messages"),
    FaultKind(name="lose a fifth", action="lose_messages", parameters={"probability": 0.2}),
    FaultKind(
        name="lose between agents",
        action="lose_messages",
        parameters={"probability": 0.5, "traffic": "between_agents"},
    ),
    FaultKind(name="delay", action="delay_messages", parameters={"delay_s": 0.3}),
    FaultKind(
        name="delay with jitter",
        action="delay_messages",
        parameters={"delay_s": 0.1, "jitter_s": 0.5},
    ),
    FaultKind(name="reorder", action="reorder_messages", parameters={"within_s": 0.5}),
    FaultKind(name="duplicate", action="duplicate_messages"),
    FaultKind(name="link down", action="link_down"),
    FaultKind(name="link down with host", action="link_down", parameters={"traffic": "with_host"}),
    FaultKind(name="partition", action="partition"),
    FaultKind(name="process killed (SIGKILL)", number=signal.SIGKILL, is_loss=True),
    FaultKind(name="process ended (SIGTERM)", number=signal.SIGTERM, is_loss=True),
    FaultKind(name="process crashes (SIGSEGV)", number=signal.SIGSEGV, is_loss=True),
    FaultKind(name="process stopped (SIGSTOP)", number=signal.SIGSTOP, is_loss=True),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class KindOutcome:
    """What became of the faults of one kind."""

    kind: str
    faults: int
    survived: int
    named: int
    seconds: tuple[float, ...]
    bytes_unaccounted: int
    hangs: int
    leftovers: int
    verdict: str

    @property
    def is_good(self) -> bool:
        """Whether there is nothing to say."""
        is_clean = not (self.bytes_unaccounted or self.hangs or self.leftovers)
        return is_clean and self.survived == self.named == self.faults


def main() -> int:
    """Run every kind, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--each", type=int, default=10, help="faults of each kind")
    parser.add_argument("--kinds", default="", help="names of kinds, comma-separated; all of them")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-i", "--inventory", help="run on its machines")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    wanted = options.kinds.split(",") if options.kinds else [kind.name for kind in KINDS]
    kinds = [kind for kind in KINDS if kind.name in wanted]
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        for kind in kinds:
            laboratory = FaultRun(kind, Path(folder) / kind.name.replace(" ", "-"), options)
            outcomes.append(laboratory.outcome())
            if not options.json:
                print(row_of(outcomes[-1]) if len(outcomes) > 1 else table_of(outcomes), flush=True)
    if options.json:
        print(json.dumps([told(outcome) for outcome in outcomes]))
    else:
        print(total_of(outcomes))
    return 0 if outcomes and all(outcome.is_good for outcome in outcomes) else 1


class FaultRun:
    """One run with faults of one kind."""

    def __init__(self, kind: FaultKind, folder: Path, options: argparse.Namespace) -> None:
        self.kind, self.folder, self.options = kind, folder, options
        is_login = kind.number is not None and options.inventory is not None
        self.every_s = EVERY_ON_BOARDS_S if is_login else EVERY_S
        self.times_s = [FIRST_S + self.every_s * number for number in range(options.each)]
        self.victims = [f"agent-{1 + number % AGENTS:02}" for number in range(options.each)]
        self.duration_s = self.times_s[-1] + FOR_S + AFTER_S
        folder.mkdir(parents=True)
        self.environment = {
            **os.environ,
            "COSMOS_RUNS": str(folder / "runs"),
            "COSMOS_STATE_DIR": str(folder / "state"),
        }
        self.processes = (
            BoardProcesses(options.inventory, self.environment)
            if options.inventory
            else LocalProcesses(folder / "state/processes")
        )
        self.sent_utc: list[float] = []

    def scenario(self) -> dict[str, Any]:
        """Return the scenario."""
        kind = self.kind
        entries = []
        for at_s, agent in zip(self.times_s, self.victims, strict=True):
            entry = {"at_s": at_s, "action": kind.action, "agents": [agent], **kind.parameters}
            entries.append(entry | ({} if kind.for_s is None else {"for_s": kind.for_s}))
        return {
            "name": "faults",
            "simulation": "./fault_simulation.py:simulation",
            "seed": self.options.seed,
            "agents": {
                "count": AGENTS,
                "tick_hz": TICK_HZ,
                "per_process": kind.per_process,
                "restarts_max": 0 if kind.per_process > 1 else 5,
            },
            "time": {"duration_s": self.duration_s, "rtf_tolerance": 0.9},
            "deadline": {"overrun_ms": 1000, "max_miss_ratio": 1},
            "recording": {"flush_interval_s": 0.1},
            "timeouts": {"silence_s": 3},
            "on_agent_loss": "continue",
            **({"timeline": entries} if kind.action else {}),
        }

    def outcome(self) -> KindOutcome:
        """Run to the end, and judge."""
        (self.folder / SIMULATION.name).write_text(SIMULATION.read_text())
        path = self.folder / "faults.yaml"
        path.write_text(yaml.safe_dump(self.scenario()))
        command = [*COSMOS, "run", str(path), "--no-report", "--json"]
        command += ["-i", self.options.inventory] if self.options.inventory else []
        process = subprocess.Popen(
            command,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        if self.kind.number is not None:
            threading.Thread(target=self._signal_agents, daemon=True).start()
        hangs = 0
        try:
            told, talk = process.communicate(timeout=self.duration_s + PATIENCE_S)
        except subprocess.TimeoutExpired:
            hangs = 1
            os.killpg(process.pid, signal.SIGKILL)
            told, talk = process.communicate()
        result = {"verdict": talk[-300:], "run": "", **(json.loads(told) if told.strip() else {})}
        return self._judged(result, hangs)

    def _judged(self, result: Mapping[str, Any], hangs: int) -> KindOutcome:
        run = self.folder / "runs" / str(result["run"])
        seconds = list(self._named(run)) if result["run"] else []
        lost = set(result.get("agents", {}).get(LOST, ()))
        is_complete = result.get("status") == "complete" and result["exit_code"] in COMPLETE
        expected = set(self.victims) if self.kind.number is not None else set()
        survived = len(self.victims) if is_complete and lost <= expected else 0
        if self.kind.number is None and result.get("exit_code") != 0:
            survived = 0
        survived = min(survived, self._felt(run, result) if result["run"] else 0)
        return KindOutcome(
            kind=self.kind.name,
            faults=len(self.victims),
            survived=survived,
            named=len(seconds),
            seconds=tuple(seconds),
            bytes_unaccounted=unaccounted(run, result) if result["run"] else 0,
            hangs=hangs,
            leftovers=len(self.processes.living(str(result["run"])))
            + len(list(self.folder.rglob("*.part"))),
            verdict=str(result.get("verdict")),
        )

    def _felt(self, run: Path, result: Mapping[str, Any]) -> int:
        """Return how many of the faults had an effect of their own, or one for each could have had; a loss is one."""
        if seen := {"hang": has_gap, "slow": has_long_step}.get(self.kind.action):
            return sum(map(partial(seen, run), self.victims, self.times_s))
        if self.kind.is_loss:
            return len(self.victims)
        counts = result.get("faults", {}).values()
        altered = (each.get(name, 0) for each in counts for name in ALTERED)
        return min(len(self.victims), sum(altered))

    def _named(self, run: Path) -> Iterator[float]:
        """Yield the time from each fault to the host's word of it, s."""
        events = [
            json.loads(line)
            for line in (run / "host/events.jsonl").read_text().splitlines()
            if '"event":' in line
        ]
        for number, agent in enumerate(self.victims):
            if self.kind.number is not None:
                if number >= len(self.sent_utc):
                    return
                from_s, key = self.sent_utc[number], "utc"
            else:
                from_s, key = self.times_s[number], "t_s"
            times = [
                when
                for event in events
                if is_word_of(event, agent, self.kind)
                and (when := seconds_of(event, key)) >= from_s - 1e-3
            ]
            if times:
                yield max(0.0, min(times) - from_s)

    def _signal_agents(self) -> None:
        """Send the agents' processes their signals, each in its time."""
        assert self.kind.number is not None
        self.processes.await_agents(self.victims, PATIENCE_S)
        began_s = time.monotonic() + FIRST_S
        for number, agent in enumerate(self.victims):
            time.sleep(max(0.0, began_s + self.every_s * number - time.monotonic()))
            now_utc = time.time_ns() * 1e-9
            if self.processes.signal(agent, self.kind.number):
                self.sent_utc.append(now_utc)


def has_gap(run: Path, agent: str, at_s: float) -> bool:
    """Tell whether an agent left ticks out between a fault's begin and a second behind its end."""
    ticks = [tick for _, tick in near(run / f"agents/{agent}/steps.jsonl", 1, at_s)]
    return any(later - tick > 1 for tick, later in pairwise(ticks))


def has_long_step(run: Path, agent: str, at_s: float) -> bool:
    """Tell whether a step meanwhile took more than a tenth of the period, of which its margin is the rest."""
    margins_us = [row[2] for row in near(run / f"agents/{agent}/ticks.jsonl", 0, at_s)]
    return min(margins_us, default=math.inf) < 0.9e6 / TICK_HZ


def near(path: Path, column: int, at_s: float) -> list[list[Any]]:
    """Return the records of a stream about a fault's time, by the column of their tick."""
    rows = [json.loads(line) for line in path.read_text().splitlines() if line.startswith("[")]
    return [row for row in rows if at_s - 0.2 <= row[column] / TICK_HZ <= at_s + FOR_S + 1.0]


def is_word_of(event: Mapping[str, Any], agent: str, kind: FaultKind) -> bool:
    """Tell whether an event of the host names the agent that a fault befell."""
    if kind.is_loss:
        return event.get("agent") == agent and event.get("state") == LOST
    return event["event"] == "action_began" and agent in event["agents"]


def seconds_of(event: Mapping[str, Any], key: str) -> float:
    """Return when an event was, s, of simulated time or since 1970."""
    if key == "t_s":
        return float(event["t_s"] if event["t_s"] is not None else -1.0)
    return datetime.fromisoformat(event["utc"]).timestamp()


def unaccounted(run: Path, result: Mapping[str, Any]) -> int:
    """Return the bytes of records that neither the manifest nor a loss that is named explains."""
    manifest = json.loads((run / "manifest.json").read_text())
    files = manifest["files"]
    named = set(result["agents"][LOST]) | set(result["agents"]["lost_on_purpose"])
    named |= {line.split(":")[0] for line in result["data"]["missing"]}
    strange = 0
    for path in sorted(run.rglob("*.jsonl")):
        name = str(path.relative_to(run))
        size, entry = path.stat().st_size, files.get(name)
        strange += size if entry is None else abs(size - int(entry["bytes"]))
        owner = path.parent.name
        if (
            entry is not None
            and owner not in named
            and (entry.get("lost") or entry.get("truncated"))
        ):
            strange += size
    return strange


COLUMNS: tuple[tuple[str, Callable[[KindOutcome], str]], ...] = (
    ("kind", lambda o: o.kind),
    ("faults", lambda o: str(o.faults)),
    ("survived", lambda o: str(o.survived)),
    ("named", lambda o: str(o.named)),
    ("s until named (median, max)", lambda o: shown_seconds(o.seconds)),
    ("bytes unaccounted", lambda o: str(o.bytes_unaccounted)),
    ("hangs", lambda o: str(o.hangs)),
    ("leftovers", lambda o: str(o.leftovers)),
)


def shown_seconds(seconds: tuple[float, ...]) -> str:
    """Return median and largest."""
    return f"{statistics.median(seconds):.3f}, {max(seconds):.3f}" if seconds else "-"


def row_of(outcome: KindOutcome) -> str:
    """Return a line of the table."""
    row = "| " + " | ".join(show(outcome) for _, show in COLUMNS) + " |"
    return row if outcome.is_good else f"{row}  {outcome.verdict}"


def table_of(outcomes: list[KindOutcome]) -> str:
    """Return the table's head, and its lines."""
    head = "| " + " | ".join(title for title, _ in COLUMNS) + " |"
    return "\n".join([head, "|---" * len(COLUMNS) + "|", *map(row_of, outcomes)])


def total_of(outcomes: list[KindOutcome]) -> str:
    """Return the last line of the table."""
    return row_of(
        KindOutcome(
            kind="all",
            faults=sum(each.faults for each in outcomes),
            survived=sum(each.survived for each in outcomes),
            named=sum(each.named for each in outcomes),
            seconds=tuple(s for each in outcomes for s in each.seconds),
            bytes_unaccounted=sum(each.bytes_unaccounted for each in outcomes),
            hangs=sum(each.hangs for each in outcomes),
            leftovers=sum(each.leftovers for each in outcomes),
            verdict="",
        )
    )


def told(outcome: KindOutcome) -> dict[str, Any]:
    """Return an outcome as a plain mapping."""
    return {name: getattr(outcome, name) for name in outcome.__dataclass_fields__}


if __name__ == "__main__":
    sys.exit(main())
