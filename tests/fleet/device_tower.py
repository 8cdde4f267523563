"""A tower of which one board has a gauge: a device whose driver lies beside the inventory, outside the scenario's folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from run_tower import RunTower
from tower import Tower

GAUGE = "/dev/shm/gauge"
"""File on the board that stands for the device: its identity, then what it measures."""
HOME = "pi02"
"""The board that has it."""
DRIVER = """
import time
from dataclasses import dataclass
from pathlib import Path

import needle

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Needs, Sample


@dataclass(frozen=True, kw_only=True)
class GaugeParameters:
    file: str = "/dev/shm/gauge"


class Gauge(Device):
    kind = DeviceKind(
        name="gauge",
        summary="a gauge",
        parameters=GaugeParameters,
        channels=(Channel(name="level"),),
        rate_hz=20.0,
        needs=Needs(
            packages=("cosmos-test-hello",),
            groups=("games",),
            boot_lines=("dtparam=i2c_arm=on",),
            requirements=("smbus2>=0.4",),
        ),
    )

    def open(self):
        import smbus2  # in the environment, as the kind needs it

        self.path = Path(self.parameters.file)
        return needle.words(self.path)[0]

    def read(self):
        return Sample(values={"level": float(needle.words(self.path)[1])}, taken_s=time.monotonic())
"""
NEEDLE = "def words(path):\n    return path.read_text().split()\n"
DEVICE = {"name": "gauge", "kind": "./drivers/gauge.py:Gauge", "rate_hz": 20, "serial": "g-1"}


class DeviceTower(RunTower):
    """A tower with a gauge on one board, and an operator at it."""

    def __init__(self, tower: Tower, folder: Path, cache: Path) -> None:
        super().__init__(tower, folder, cache)
        drivers = folder / "drivers"
        drivers.mkdir()
        (drivers / "gauge.py").write_text(DRIVER)
        (drivers / "needle.py").write_text(NEEDLE)

    def hang(self, **device: Any) -> None:
        """Let the inventory be all boards, one with the gauge."""
        self.boards = tuple(self.tower.boards)
        machines = {HOME: {"cosmos_devices": [{**DEVICE, **device}]}}
        self.tower.write_inventory(self.inventory, machines)

    def plug(self) -> None:
        self.tower.run(HOME, f"echo 'g-1 3.5' > {GAUGE}.new && mv {GAUGE}.new {GAUGE}")

    def unplug(self) -> None:
        self.tower.run(HOME, f"rm -f {GAUGE}")

    def scenario(self, **changes: Any) -> Path:
        """Write a scenario whose agents use the gauge where they have one."""
        hardware = {
            "use": [{"devices": ["gauge"]}],
            "stale_ratio": 1,
            **changes.pop("hardware", {}),
        }
        changes = {"agents": {"count": len(self.tower.boards), "tick_hz": 20}, **changes}
        return super().scenario(hardware=hardware, **changes)

    def up(self, *arguments: str) -> dict[str, Any]:
        """Run `cosmos up` for the scenario, and return what it told of each board."""
        done = self.cosmos("up", "-i", self.inventory, self.scenario(), "--json", *arguments)
        assert done.returncode == 0, done.stdout + done.stderr
        return {each["machine"]: each for each in json.loads(done.stdout)["machines"]}

    def samples(self) -> list[list[Any]]:
        """Return the gauge's records that have come here."""
        path = self.directory / "devices" / HOME / "gauge" / "level.jsonl"
        lines = map(json.loads, path.read_text().splitlines()[1:])
        return [line for line in lines if isinstance(line, list)]

    def device(self) -> dict[str, Any]:
        """Return what run.json says of the gauge."""
        return dict(self.document["devices"][f"{HOME}/gauge"])
