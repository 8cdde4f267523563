"""Processes of a run, on this computer or on the machines of an inventory: found, signalled, and looked for afterwards."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from signal import Signals
from typing import Any

from madns_runtime.processes import read_start_ticks

COSMOS = (sys.executable, "-P", "-m", "cosmos_cli.start")
LOOK_S = 0.1
LOGIN_S = 60.0
"""For one command on a machine."""


class LocalProcesses:
    """
    Processes of this computer.

    Args:
        register: Folder of the register of processes, in which no other run is.
    """

    def __init__(self, register: Path) -> None:
        self._register = register

    def await_agents(self, agents: Collection[str], patience_s: float) -> None:
        """Wait until the last of these agents has a process."""
        until_s = time.monotonic() + patience_s
        while not all(map(self._pid_of, agents)) and time.monotonic() < until_s:
            time.sleep(LOOK_S)

    def signal(self, agent: str, number: Signals) -> bool:
        """Send a signal to an agent's process, and return whether there is one."""
        pid = self._pid_of(agent)
        return pid is not None and _succeeds(["kill", "-s", number.name[3:], str(pid)])

    def living(self, run: str) -> list[str]:
        """Return the names of what still lives."""
        return [
            str(entry.get("name"))
            for entry in self._entries()
            if read_start_ticks(int(entry["pid"])) == entry["start_ticks"]
        ]

    def _pid_of(self, agent: str) -> int | None:
        for entry in self._entries():
            if entry.get("role") == "agent" and entry.get("name") == agent:
                return int(entry["pid"])
        return None

    def _entries(self) -> Iterator[Mapping[str, Any]]:
        for path in sorted(self._register.glob("*.json"), reverse=True):
            try:
                yield json.loads(path.read_text())
            except (OSError, ValueError):
                continue


class BoardProcesses:
    """
    Processes on the machines of an inventory, by `cosmos ps` and `cosmos exec`.

    Args:
        inventory: Its file.
        environment: Of the commands; it names a register in which no other run is.
    """

    def __init__(self, inventory: str, environment: Mapping[str, str]) -> None:
        self._inventory, self._environment = inventory, environment
        self._places: dict[str, tuple[str, int]] = {}
        """Machine and process of each agent as it was started first."""

    def await_agents(self, agents: Collection[str], patience_s: float) -> None:
        """Wait until all of these agents have a process."""
        until_s = time.monotonic() + patience_s
        while not set(agents) <= self._places.keys() and time.monotonic() < until_s:
            time.sleep(LOOK_S)
            for entry in self._entries():
                if entry["role"] == "agent" and entry["machine"]:
                    self._places.setdefault(entry["name"], (entry["machine"], entry["pid"]))

    def signal(self, agent: str, number: Signals) -> bool:
        """Send a signal to an agent's process, once; return whether that succeeded."""
        machine, pid = self._places.pop(agent, ("", 0))
        command = f"kill -s {number.name[3:]} {pid}"
        return bool(machine) and _succeeds(
            [*COSMOS, "exec", "-q", "-i", self._inventory, "-l", machine, command],
            self._environment,
        )

    def living(self, run: str) -> list[str]:
        """Return the names of what still lives of a run, here and there."""
        return [str(entry["name"]) for entry in self._entries() if entry["run"] == run]

    def _entries(self) -> Iterator[Mapping[str, Any]]:
        done = subprocess.run(
            [*COSMOS, "ps", "--all", "--json", "-i", self._inventory],
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=LOGIN_S,
            check=False,
        )
        if done.returncode != 0:
            raise RuntimeError(f"cosmos ps ended with {done.returncode}: {done.stderr}")
        for run in json.loads(done.stdout)["runs"]:
            for entry in run["processes"]:
                yield {**entry, "run": run["run"]}


def _succeeds(command: list[str], environment: Mapping[str, str] | None = None) -> bool:
    done = subprocess.run(
        command, env=environment, capture_output=True, timeout=LOGIN_S, check=False
    )
    return done.returncode == 0
