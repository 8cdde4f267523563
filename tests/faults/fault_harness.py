"""
Runs the real `cosmos` in an environment of its own, finds its processes, and reads what it leaves.

Every process that descends from a test carries COSMOS_TEST_ID in its environment, whatever becomes of
its parents: /proc tells who of them lives.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml
import zstandard
from faulty_simulation import STRUCK
from harness.talking_process import Marked, TalkingProcess, find_marked
from harness.waiting import wait_until

from madns_runtime.recording.reader import read_stream

COSMOS = (sys.executable, "-m", "cosmos_cli.start")
PLUGIN = Path(__file__).with_name("faulty_simulation.py")
TEST_ID = "COSMOS_TEST_ID"
PATIENCE_S = 90.0
"""A shared machine may be slow; what takes this long hangs."""
END_S = 60.0
"""Agents end within 5 s of their host's or operator's death; the rest is slack for a busy machine. A run is longer."""
POLL_S = 0.02
SCENARIO: dict[str, Any] = {
    "name": "fault",
    "simulation": "./faulty_simulation.py:simulation",
    "agents": {"count": 3, "tick_hz": 20},
    "time": {"duration_s": 2, "rtf_tolerance": 0.9},
    "deadline": {"overrun_ms": 1000, "max_miss_ratio": 1},
    "timeouts": {
        "host_start_s": 300,
        "agents_ready_s": 300,
        "start_lead_s": 0.3,
        "shutdown_s": 60,
        "silence_s": 30,
    },
    "recording": {"flush_interval_s": 0.1},
    "executor": {"kind": "thread"},
}
"""Its records come to a busy machine's disk, too: where somebody hangs at the end, a test gives less time for that."""


class Laboratory:
    """A folder with runs, register and temporary files of its own."""

    def __init__(self, folder: Path) -> None:
        self.id = secrets.token_hex(8)
        self.folder = folder
        self.runs = folder / "runs"
        self.state = folder / "state"
        self.temporary = folder / "tmp"
        self.temporary.mkdir()
        shutil.copy(PLUGIN, folder)
        self.environment = {
            **os.environ,
            TEST_ID: self.id,
            "COSMOS_STATE_DIR": str(self.state),
            "COSMOS_RUNS": str(self.runs),
            "TMPDIR": str(self.temporary),
            "PYTHONDONTWRITEBYTECODE": "1",
            "NO_COLOR": "1",
        }
        self.started: list[Run] = []

    def start(
        self,
        *arguments: str,
        faults: dict[str, Any] | None = None,
        environment: dict[str, str] | None = None,
        new_group: bool = False,
        prefix: Sequence[str] = (),
    ) -> Run:
        """Start `cosmos run` of the scenario, by the command *prefix*; *arguments* are mostly --set."""
        path = self.folder / "fault.yaml"
        path.write_text(yaml.safe_dump({**SCENARIO, "parameters": faults or {}}))
        command = [*prefix, *COSMOS, "run", str(path), "--no-report", *arguments]
        run = Run(self, command, {**self.environment, **(environment or {})}, new_group)
        self.started.append(run)
        return run

    def cosmos(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run another command to its end."""
        return subprocess.run(
            [*COSMOS, *arguments],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def living(self) -> list[Marked]:
        """Return every process of this test that has not ended."""
        return find_marked(f"{TEST_ID}={self.id}")

    def entries(self) -> list[dict[str, Any]]:
        """Return what the register holds."""
        folder = self.state / "processes"
        entries = []
        for path in sorted(folder.glob("[0-9]*.json")) if folder.is_dir() else ():
            try:
                entries.append(json.loads(path.read_text()))
            except (OSError, json.JSONDecodeError):
                continue
        return entries

    def leftovers(self) -> list[str]:
        """Return files that a run should have removed."""
        folder = self.state / "processes"
        registered = [path.name for path in folder.iterdir()] if folder.is_dir() else []
        parts = [path.name for path in self.folder.rglob("*.part")]
        return registered + parts + [path.name for path in self.temporary.iterdir()]


class Run(TalkingProcess):
    """One `cosmos run`."""

    patience_s = PATIENCE_S

    def __init__(
        self, laboratory: Laboratory, command: Sequence[str], environment: dict[str, str], new: bool
    ) -> None:
        self.laboratory = laboratory
        self.launch(command, environment, start_new_session=new)

    # While it runs --------------------------------------------------------------------------------

    def wait_until_running(self, then_s: float = 0.5) -> None:
        """Wait until simulated time has run for *then_s*, and every agent has recorded a tick."""
        self.wait_for("\nrunning\n")
        time.sleep(SCENARIO["timeouts"]["start_lead_s"] + then_s)
        self.wait_until(self._all_tick, "ticks of all agents")

    def _all_tick(self) -> bool:
        paths = list(self.directory.glob("agents/*/ticks.jsonl"))
        # The first line tells what the others hold.
        return bool(paths) and all(path.read_bytes().count(b"\n") > 1 for path in paths)

    def wait_until_struck(self) -> None:
        """Wait until what a plug-in is to do wrong has begun."""
        self.wait_until((self.laboratory.folder / STRUCK).exists, "fault of the plug-in")

    def wait_until(self, condition: Callable[[], Any], what: str) -> Any:
        """Wait for something that must come while the run lives."""
        return wait_until(
            condition,
            lambda: f"no {what}\n{self.talk}",
            patience_s=self.patience_s,
            process=self.process,
        )

    def pid_of(self, name: str, *, but: int = 0) -> int:
        """Wait for a process (host, loopback, agent-02, operator) to register and return its number."""

        def find() -> int | None:
            found = [entry["pid"] for entry in self.laboratory.entries() if entry["name"] == name]
            return next((pid for pid in found if pid != but), None)

        return int(self.wait_until(find, f"process of {name}"))

    def wait_until_ticking(self, stream: Path) -> None:
        """Wait until a stream of ticks, which may not have begun, holds one."""
        # The first line tells what the others hold.
        self.wait_until(
            lambda: stream.exists() and stream.read_bytes().count(b"\n") > 1, f"tick in {stream}"
        )

    def complete(self) -> None:
        """Have it complete, by the word of a timeline, as soon as simulated time runs."""
        order = ("inject", "last", "run", "stop")
        self.wait_until(lambda: self.laboratory.cosmos(*order).returncode == 0, "stop of the run")

    # What it leaves -------------------------------------------------------------------------------

    @property
    def directory(self) -> Path:
        """The newest run directory."""
        return max(path for path in self.laboratory.runs.iterdir() if path.is_dir())

    @property
    def document(self) -> dict[str, Any]:
        return json.loads((self.directory / "run.json").read_text())  # type: ignore[no-any-return]

    @property
    def result(self) -> dict[str, Any]:
        """What the host reported."""
        return json.loads((self.directory / "result.json").read_text())  # type: ignore[no-any-return]

    def describe(self) -> str:
        """Return all that helps to understand a failed assertion."""
        errors = [
            f"--- {path}\n{path.read_text()}"
            for path in self.laboratory.folder.rglob("stderr.txt")
            if path.stat().st_size
        ]
        return "\n".join([self.talk, self.out, *errors])


def check_ending(
    run: Run, code: int, status: str, *said: str, has_records: bool = True
) -> dict[str, Any]:
    """
    Assert how a run ended: code, status, what its talk and verdict hold, and sound evidence.

    Args:
        run: It has ended.
        code: Exit code.
        status: Of run.json.
        said: Each must be in what `cosmos run` printed.
        has_records: Whether anybody must have come so far as to record.
    """
    assert run.finish() == code, run.describe()
    document = run.document
    assert (document["status"], document["exit_code"]) == (status, code), run.describe()
    for text in said:
        assert text in run.talk + run.out, f"{text!r} is not in:\n{run.describe()}"
    # The last line is the verdict, and where the evidence lies.
    assert run.out.splitlines()[-1] == f"{document['verdict']} | {run.directory}"
    if code in (1, 130):
        assert document["who"], document
        assert document["reason"], document
    assert "Traceback" not in run.talk, run.describe()
    check_evidence(run.directory, document, has_records=has_records)
    return document


def check_evidence(directory: Path, document: dict[str, Any], *, has_records: bool = True) -> None:
    """Assert that every stream can be read, and that the manifest and the package hold every file."""
    streams = sorted(directory.glob("*/**/*.jsonl"))
    assert streams or not has_records
    for path in streams:
        reading = read_stream(path)
        for _ in reading.records():
            pass
        # At most the last line may be cut; nothing before it.
        assert reading.state.damaged == 0, path
    manifest = json.loads((directory / "manifest.json").read_text())["files"]
    files = {path.relative_to(directory).as_posix() for path in directory.rglob("*.*")}
    files -= {"manifest.json"} | {name for name in files if (directory / name).is_dir()}
    assert set(manifest) == files
    for name, entry in manifest.items():
        assert entry["bytes"] == (directory / name).stat().st_size, name
    records = sum(entry.get("records", 0) for entry in manifest.values())
    assert document["records"]["written"] == records
    bundle = directory.with_name(f"{directory.name}.tar.zst")
    with (
        bundle.open("rb") as raw,
        zstandard.ZstdDecompressor().stream_reader(raw) as plain,
        tarfile.open(fileobj=plain, mode="r|") as archive,
    ):
        packed = {member.name.split("/", 1)[1] for member in archive}
    assert packed == {*files, "manifest.json"}


BOARD_HALF = """\
import sys, time
from madns_runtime.plugin.api import AgentSimulation
if sys.argv[0].endswith("agent.py"):  # where agents run, not where the scenario is checked
    {statement}
class Agent(AgentSimulation):
    def step(self, tick): ...
"""


def do_on_import(laboratory: Laboratory, statement: str) -> None:
    """Let line 4 of half.py, the agents' half, be *statement*: done where agents are started."""
    (laboratory.folder / "half.py").write_text(BOARD_HALF.format(statement=statement))
    plugin = laboratory.folder / PLUGIN.name
    plugin.write_text(PLUGIN.read_text().replace('agent=":FaultyAgent"', 'agent="./half.py:Agent"'))


def hang_on_import(laboratory: Laboratory) -> None:
    """Let the import of the agents' half never end."""
    do_on_import(laboratory, "time.sleep(600)")


def wait_until_ended(
    laboratory: Laboratory, *, but: Sequence[int] = (), limit_s: float = END_S
) -> None:
    """Assert that nobody of a test, *but* some, lives after *limit_s*."""
    until_s = time.monotonic() + limit_s
    while alive := [process for process in laboratory.living() if process.pid not in but]:
        assert time.monotonic() < until_s, f"still running after {limit_s:g} s: {alive}"
        time.sleep(POLL_S)
