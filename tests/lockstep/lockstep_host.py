"""Starts the real host of a lockstep run, without an operator's side, and reads what it says and leaves."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from madns_runtime.conditions.condition import Condition
from madns_runtime.config import (
    Agents,
    ExecutorSettings,
    HostLaunch,
    RunConfig,
    Timeouts,
    TimeSettings,
    to_mapping,
)
from madns_runtime.timeline.entries import ScheduledEntry

HERE = Path(__file__).parent
PATIENCE_S = 200.0
"""A shared machine may be slow; what takes this long hangs."""


class HostRun:
    """One host process."""

    def __init__(
        self,
        folder: Path,
        *,
        run: str = "0001-lockstep",
        per_process: int = 2,
        seed: int = 7,
        fault: str = "",
        timeouts: Timeouts | None = None,
        executor: str = "thread",
        restarts_max: int | None = None,
        simulation: str = "./lockstep_simulation.py:simulation",
        timeline: tuple[ScheduledEntry, ...] = (),
        conditions: tuple[Condition, ...] = (),
    ) -> None:
        """With *restarts_max* the run goes on without an agent that is lost."""
        self.folder = folder
        config = RunConfig(
            run=run,
            scenario="lockstep",
            simulation=simulation,
            base_directory=str(HERE),
            agents=Agents(
                count=6, tick_hz=10.0, per_process=per_process, restarts_max=restarts_max or 0
            ),
            on_agent_loss="abort" if restarts_max is None else "continue",
            time=TimeSettings(mode="lockstep", duration_s=1.0),
            timeouts=timeouts or Timeouts(shutdown_s=60.0),
            seed=seed,
            executor=ExecutorSettings(kind=executor, workers=2),
            parameters={} if timeline else {"fault": fault},
            timeline=timeline,
            conditions=conditions,
        )
        (folder / "host").mkdir(parents=True)
        launch = HostLaunch(
            config=config, run_key_hex="0" * 64, session_hex="0", directory=str(folder / "host")
        )
        self._stderr = (folder / "stderr.txt").open("w")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "madns_runtime.host"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env={
                **os.environ,
                "COSMOS_STATE_DIR": str(folder.parent / "state"),
                "PYTHONHASHSEED": "0",
            },
        )
        self.say(to_mapping(launch))
        self.events: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def say(self, document: dict[str, Any]) -> None:
        """Write one line to the host."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(document).encode() + b"\n")
        self.process.stdin.flush()

    def result(self) -> dict[str, Any]:
        """Wait for the end, and return the result that was left beside the records."""
        self.process.wait(PATIENCE_S)
        self._thread.join(PATIENCE_S)
        assert self.process.stdin is not None
        self.process.stdin.close()
        self._stderr.close()
        result: dict[str, Any] = json.loads((self.folder / "host" / "result.json").read_text())
        return result

    def hashes(self) -> dict[str, str]:
        """Return what was recorded, by file."""
        return {
            str(path.relative_to(self.folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(self.folder.rglob("*.jsonl"))
        }

    def records(self, path: str) -> list[Any]:
        """Return the records of a stream of arrays."""
        lines = (self.folder / path).read_text().splitlines()
        return [value for line in lines if isinstance(value := json.loads(line), list)]

    def events_of(self, who: str, number: str = "") -> list[dict[str, Any]]:
        """Return what happened to the host, or to agents/NAME, in the incarnation whose files end in *number*."""
        lines = (self.folder / who / f"events{number}.jsonl").read_text().splitlines()
        return [event for line in lines if "event" in (event := json.loads(line))]

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.events.append(json.loads(line))
