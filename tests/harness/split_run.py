"""A synthetic run whose records lie on "machines": folders below a temporary root, reached through pipes."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from cosmos_cli.collect.retrieve import Retrieval
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.local import LocalConnection, LocalStream
from cosmos_cli.fleet.target import Target
from harness.registered import registered
from harness.synthetic_run import SyntheticRun, make_config

SESSION = "00112233445566ff"


class SplitRun:
    """A whole run of some agents per machine; what is not on a machine is in the run directory."""

    def __init__(
        self, root: Path, machines: int = 2, *, agents_each: int = 1, ticks: int = 200
    ) -> None:
        self.names = tuple(f"pi{index:02d}" for index in range(1, machines + 1))
        config = make_config(machines * agents_each, ticks=ticks)
        self.made = SyntheticRun(root / "runs", config).write()
        self.run = self.made.run
        shutil.rmtree(self.run.path / "machines/loopback")
        self.targets = {
            name: Target(
                name=name,
                address=f"192.0.2.{index}",
                python=sys.executable,
                root=str(root / "boards" / name),
            )
            for index, name in enumerate(self.names, 1)
        }
        self.agents = {
            name: self.made.names[index * agents_each : (index + 1) * agents_each]
            for index, name in enumerate(self.names)
        }
        self._write_plan()
        for name in self.names:
            self._move_out(name)

    def directory(self, machine: str) -> Path:
        """Where a machine keeps this run."""
        return Path(Layout(self.targets[machine].root).run(self.run.name, SESSION))

    def state(self, machine: str) -> Path:
        return Path(Layout(self.targets[machine].root).state)

    def connections(self, **others) -> dict:
        return {name: LocalConnection(self.targets[name]) for name in self.names} | others

    def retrieve(self, connections=None, **more) -> dict:
        """Retrieve, and return the outcomes by machine."""
        given = self.connections() if connections is None else connections
        with Retrieval(self.run, options=None, connections=given, **more) as retrieval:
            outcomes = retrieval.fetch()
        return {outcome.machine: outcome for outcome in outcomes}

    def visit(self, connections=None) -> Retrieval:
        given = self.connections() if connections is None else connections
        return Retrieval(self.run, options=None, connections=given)

    def living(self, machine: str, role: str, name: str):
        """Have a process of this run live on a machine."""
        places = {"directory": self.directory(machine), "state": self.state(machine)}
        return registered(self.run.name, role, name, **places)

    def there(self, machine: str) -> dict[str, str]:
        return hashes(self.directory(machine))

    def leave_result(self) -> None:
        write_json(self.run.left_result_json, self.made.result())

    def _write_plan(self) -> None:
        plan = self.run.read_json(self.run.plan_json)
        machines = {
            name: {
                "address": target.address,
                "connection": "ssh",
                "agents": list(self.agents[name]),
                "target": target.to_mapping(),
                "directory": str(self.directory(name)),
            }
            for name, target in self.targets.items()
        }
        write_json(self.run.plan_json, {**plan, "machines": machines, "session": SESSION})

    def _move_out(self, machine: str) -> None:
        there = self.directory(machine)
        self.made.write_health(5, folder=f"machines/{machine}", source=machine)
        for path in (f"machines/{machine}", *(f"agents/{name}" for name in self.agents[machine])):
            (there / path).parent.mkdir(parents=True, exist_ok=True)
            (self.run.path / path).rename(there / path)


class CutConnection(LocalConnection):
    """A link that breaks after so many bytes or whole frames have come; *change* may alter what comes."""

    def __init__(
        self,
        target: Target,
        *,
        bytes_max: int | None = None,
        frames_max: int | None = None,
        change: Callable[[bytes], bytes] = bytes,
    ) -> None:
        super().__init__(target)
        self._bytes_max = bytes_max
        self._frames_max = frames_max
        self._change = change
        self.came = bytearray()

    def open(self, command: str) -> LocalStream:
        stream = super().open(command)
        read = stream.read

        def cut_read(count: int, *, timeout_s: float = 0.0) -> bytes:
            if self._bytes_max is not None:
                count = min(count, self._bytes_max - len(self.came))
                if count <= 0:
                    raise MachineFailure(FailureKind.LOST, "the connection broke")
            data = self._change(read(count, timeout_s=timeout_s))
            if self._frames_max is not None:
                ends = frame_ends(self.came + data)
                if len(ends) >= self._frames_max:
                    self._bytes_max = ends[self._frames_max - 1]
                    data = data[: self._bytes_max - len(self.came)]
            self.came += data
            return data

        stream.read = cut_read
        return stream


def frame_ends(data: bytes) -> list[int]:
    """Return where each frame that has come whole ends."""
    ends, at = [], 0
    while (end := data.find(b"\n", at) + 1) > 0:
        at = end + json.loads(data[at:end])["body"]
        if at > len(data):
            break
        ends.append(at)
    return ends


class LyingConnection(LocalConnection):
    """A machine whose frames are altered: *lie* takes and returns header and body."""

    def __init__(self, target, lie):
        super().__init__(target)
        self._lie = lie

    def open(self, command):
        stream = super().open(command)
        read, lie = stream.read, self._lie
        pending, ready = bytearray(), bytearray()

        def lying_read(count, *, timeout_s=0.0):
            while not ready:
                data = read(1 << 20, timeout_s=timeout_s)
                if not data:
                    return b""
                pending.extend(data)
                while (end := pending.find(b"\n")) >= 0:
                    header = json.loads(pending[:end])
                    size = end + 1 + header["body"]
                    if len(pending) < size:
                        break
                    header, body = lie(header, bytes(pending[end + 1 : size]))
                    del pending[:size]
                    ready.extend(json.dumps(header | {"body": len(body)}).encode() + b"\n" + body)
                if not ready:
                    raise BlockingIOError
            data = bytes(ready[:count])
            del ready[:count]
            return data

        stream.read = lying_read
        return stream


def pieces(change):
    """Return a lie about pieces of files."""

    def lie(header, body):
        value = header.get("value")
        if isinstance(value, dict) and "offset" in value:
            value, body = change(value, body)
            header = header | {"value": value}
        return header, body

    return lie


def hashes(folder: Path) -> dict[str, str]:
    """Return every file below a folder, and the hash of its content."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
