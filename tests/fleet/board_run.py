"""A run whose records lie on the boards of a tower, written by the real recorder and copied there."""

from __future__ import annotations

import json
import os
import subprocess
import tarfile
from pathlib import Path

from harness.cosmos_command import CosmosCommand
from harness.split_run import SESSION, SplitRun, hashes
from tower import Tower

from cosmos_cli.fleet.target import Target

ROOT = "/home/pi/cosmos"
PATIENCE_S = 120.0


class BoardRun:
    """A finished run of one agent a board; the host was here and left its result."""

    def __init__(self, root: Path, tower: Tower, *, boards: int, noise_bytes: int = 0) -> None:
        self.tower = tower
        self.split = SplitRun(root, machines=boards)
        self.split.leave_result()
        self.run = self.split.run
        self.names = self.split.names
        self.cosmos = CosmosCommand(
            root, COSMOS_CACHE=str(root / "cache"), **tower.operator_environment()
        )
        if noise_bytes:
            noise = self.split.directory("pi01") / "agents/agent-01/noise.bin"
            noise.write_bytes(os.urandom(noise_bytes))
        self.there = {name: self.split.there(name) for name in self.names}
        self._point_at_boards()
        for name in self.names:
            self._copy_to(name)

    @property
    def directory(self) -> str:
        """The run's, on every board."""
        return f"{ROOT}/runs/{self.run.name}-{SESSION[:8]}"

    def lies_on(self, name: str) -> bool:
        """Tell whether the run's directory is on a board."""
        return self.is_there(name, self.directory)

    def is_there(self, name: str, path: str) -> bool:
        """Tell whether a path is on a board."""
        status = self.tower.run(name, f"test -e {path}", check=False).returncode
        assert status in (0, 1), f"{name} does not answer"
        return status == 0

    def is_here(self, *names: str) -> bool:
        """Tell whether all that these boards had is here, byte for byte."""
        here = hashes(self.run.path)
        return all(self.there[name].items() <= here.items() for name in names or self.names)

    def missing(self) -> set[str]:
        """Return who is named in run.json because data are missing."""
        lines = json.loads(self.run.run_json.read_bytes())["data"]["missing"]
        return {line.split(":")[0] for line in lines}

    def _point_at_boards(self) -> None:
        plan = json.loads(self.run.plan_json.read_bytes())
        for name, entry in plan["machines"].items():
            entry["target"] = Target(name=name, address=name, root=ROOT).to_mapping()
            entry["directory"] = self.directory
        self.run.plan_json.write_text(json.dumps(plan))

    def _copy_to(self, name: str) -> None:
        command = f"mkdir -p {self.directory} && tar -x -C {self.directory} && sync -f ."
        ssh = ["ssh", "-F", str(self.tower.ssh_config), name, command]
        with subprocess.Popen(ssh, stdin=subprocess.PIPE) as process:
            assert process.stdin is not None
            with tarfile.open(fileobj=process.stdin, mode="w|") as archive:
                for path in sorted(self.split.directory(name).iterdir()):
                    archive.add(path, path.name)
            process.stdin.close()
        assert process.returncode == 0
