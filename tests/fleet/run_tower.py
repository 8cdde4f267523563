"""`cosmos run` as a user runs it, on the boards of a tower."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml
from harness.cosmos_command import CosmosCommand
from harness.talking_process import TalkingProcess, find_marked
from harness.waiting import wait_until
from harness.wheel_cache import begin_cache
from tower import Tower

PATIENCE_S = 150.0
COSMOS = (sys.executable, "-m", "cosmos_cli.start")
MARK = "COSMOS_TEST_RUN_TOWER"
SCENARIO: dict[str, Any] = {
    "name": "board",
    "simulation": "counter",
    "agents": {"count": 6, "tick_hz": 20},
    "time": {"duration_s": 60, "rtf_tolerance": 0.9},
    "deadline": {"overrun_ms": 1000, "max_miss_ratio": 1},
    "timeouts": {"shutdown_s": 5},
}
ENDLESS = {"duration_s": 600, "rtf_tolerance": 0.9}
"""Of a run that ends by what happens to it, or by a word, however long that takes to come."""
PATIENT = {"agents_ready_s": 120, "silence_s": 30, "complete_s": 60, "shutdown_s": 60}
"""Timeouts of a run from which nobody is taken: boards that share this machine's processors wait for them."""
LIVING = "pgrep -af '[m]adns_runtime|[P]ACKAGE=' || true"
MEND = ("thaw", "up", "noloss", "poweron")


class RunTower(TalkingProcess):
    """A tower that is ready for runs, and one operator at it."""

    patience_s = PATIENCE_S

    def __init__(self, tower: Tower, folder: Path, cache: Path) -> None:
        self.tower = tower
        self.folder = folder
        self.runs = folder / "runs"
        self.scenarios = folder / "scenarios"
        self.scenarios.mkdir()
        self.inventory = folder / "tower.yaml"
        self.cosmos = CosmosCommand(
            folder,
            **tower.operator_environment(),
            **{"COSMOS_CACHE": str(begin_cache(cache)), MARK: str(folder)},
        )
        self.environment = self.cosmos.environment
        self.boards: tuple[str, ...] = ()

    # Commands ---------------------------------------------------------------------------------------

    def choose(self, *boards: str, here: bool = False, **variables: Any) -> None:
        """Let the inventory be these boards, and this computer if *here*."""
        self.boards = boards or tuple(self.tower.boards)
        machines: Mapping[str, Any] = {"here": {"ansible_connection": "local"}} if here else {}
        self.tower.write_inventory(self.inventory, machines, boards or None, **variables)

    def scenario(self, **changes: Any) -> Path:
        path = self.scenarios / "board.yaml"
        path.write_text(yaml.safe_dump({**SCENARIO, **changes}))
        return path

    def start(self, *arguments: str, **changes: Any) -> None:
        command = ["run", str(self.scenario(**changes)), "-i", str(self.inventory), "--no-report"]
        self.launch([*COSMOS, *command, *arguments], self.environment, start_new_session=True)

    def stop(self) -> None:
        """End the run in good order: what had to happen in it has happened."""
        order = ("inject", "last", "run", "stop")
        # Refused until simulated time runs, which is a moment after the run is said to.
        wait_until(lambda: self.cosmos(*order).returncode == 0, "stop", patience_s=self.patience_s)

    def interrupt(self) -> None:
        self.signal(signal.SIGINT)

    # What there is ----------------------------------------------------------------------------------

    @property
    def verdict(self) -> str:
        return self.out.splitlines()[-1]

    @property
    def directory(self) -> Path:
        return max(self.runs.glob("[0-9]*-board"))

    @property
    def document(self) -> dict[str, Any]:
        return dict(json.loads((self.directory / "run.json").read_bytes()))

    def problems(self, machine: str) -> list[str]:
        return [p["text"] for p in self.document["problems"] if p["machine"] == machine]

    def wait_until_running(self) -> None:
        self.wait_for("\nrunning\n")
        time.sleep(1.5)

    def living(self) -> dict[str, list[str]]:
        """Return what lives of any run, on the boards of the inventory and here."""
        with ThreadPoolExecutor(len(self.boards)) as pool:
            answers = pool.map(lambda name: self.tower.run(name, LIVING).stdout, self.boards)
            found = {n: a.splitlines() for n, a in zip(self.boards, answers, strict=True)}
        found["here"] = [str(pid) for pid in self._living_here()]
        return {name: lines for name, lines in found.items() if lines}

    def mend(self) -> None:
        """Undo the faults of a test, and see to it that nothing of its run is left."""
        states = self.tower.state()["boards"]
        for name in self.boards:
            for fault in MEND:
                if fault != "poweron" or states[name]["power"] == "off":
                    self.tower.fault(name, fault)
        for name in self.boards:
            self.tower.wait_until_on(name)
        if self.process is not None and self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        for pid in self._living_here():
            os.kill(pid, signal.SIGKILL)
        with ThreadPoolExecutor(len(self.boards)) as pool:
            list(pool.map(self._clean, self.boards))

    def _clean(self, name: str) -> None:
        self.tower.run(name, "pkill -KILL -f '[m]adns_runtime'; rm -rf cosmos/runs/*", check=False)

    def _living_here(self) -> list[int]:
        return [process.pid for process in find_marked(f"{MARK}={self.folder}")]
