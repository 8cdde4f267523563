"""`cosmos run` as a user runs it, on the boards of a tower."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml
from tower import Tower

PATIENCE_S = 150.0
POLL_S = 0.05
COSMOS = (sys.executable, "-m", "cosmos_cli.start")
MARK = "COSMOS_TEST_RUN_TOWER"
SCENARIO: dict[str, Any] = {
    "name": "board",
    "simulation": "counter",
    "agents": {"count": 6, "tick_hz": 20},
    "time": {"duration_s": 60, "rtf_tolerance": 0.9},
    "deadline": {"tolerance_ms": 1000, "max_miss_ratio": 1},
    "timeouts": {"shutdown_s": 5},
}
LIVING = "pgrep -af '[m]adns_runtime|[P]ACKAGE=' || true"
MEND = ("thaw", "up", "noloss", "poweron")


class RunTower:
    """A tower that is ready for runs, and one operator at it."""

    def __init__(self, tower: Tower, folder: Path, cache: Path) -> None:
        self.tower = tower
        self.folder = folder
        self.runs = folder / "runs"
        self.scenarios = folder / "scenarios"
        self.scenarios.mkdir()
        self.inventory = folder / "tower.yaml"
        self.environment = {
            **os.environ,
            **tower.operator_environment(),
            "COSMOS_STATE_DIR": str(folder / "state"),
            "COSMOS_RUNS": str(self.runs),
            "COSMOS_CACHE": str(cache),
            MARK: str(folder),
            "NO_COLOR": "1",
        }
        self.process: subprocess.Popen[str] | None = None
        self.boards: tuple[str, ...] = ()
        self._lines: list[str] = []
        self._out = ""
        self._threads: list[threading.Thread] = []

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

    def cosmos(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*COSMOS, *map(str, arguments)],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            stdin=subprocess.DEVNULL,
            check=False,
        )

    def start(self, *arguments: str, **changes: Any) -> None:
        command = ["run", str(self.scenario(**changes)), "-i", str(self.inventory), "--no-report"]
        self._lines, self._out = [], ""
        self.process = subprocess.Popen(
            [*COSMOS, *command, *arguments],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._threads = [
            threading.Thread(target=read, args=(self.process,), daemon=True)
            for read in (self._read_err, self._read_out)
        ]
        for thread in self._threads:
            thread.start()

    def finish(self) -> int:
        assert self.process is not None
        try:
            code = self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"has not ended: {self.talk}") from None
        for thread in self._threads:
            thread.join(PATIENCE_S)
        return code

    def interrupt(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGINT)

    # What there is ----------------------------------------------------------------------------------

    @property
    def talk(self) -> str:
        return "".join(self._lines)

    @property
    def verdict(self) -> str:
        return self._out.splitlines()[-1]

    @property
    def directory(self) -> Path:
        return max(self.runs.glob("[0-9]*-board"))

    @property
    def document(self) -> dict[str, Any]:
        return dict(json.loads((self.directory / "run.json").read_bytes()))

    def problems(self, machine: str) -> list[str]:
        return [p["text"] for p in self.document["problems"] if p["machine"] == machine]

    def wait_until(self, condition: Callable[[], Any], what: str) -> Any:
        until_s = time.monotonic() + PATIENCE_S
        while not (value := condition()):
            assert time.monotonic() < until_s, f"no {what}\n{self.talk}"
            time.sleep(POLL_S)
        return value

    def wait_for(self, text: str) -> None:
        self.wait_until(lambda: text in self.talk, f"{text!r} in its talk")

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
        mark = f"{MARK}={self.folder}".encode()
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdecimal() and int(entry.name) != os.getpid():
                try:
                    is_ours = mark in (entry / "environ").read_bytes().split(b"\0")
                    state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                except OSError:
                    continue
                if is_ours and state not in "ZX":
                    found.append(int(entry.name))
        return found

    def _read_err(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            self._lines.append(line)
        process.stderr.close()

    def _read_out(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        self._out = process.stdout.read()
        process.stdout.close()
