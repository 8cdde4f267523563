"""The thesis's own set-up on a tower: 24 boards count with the host at 20 Hz, and pi22 reads a Sense HAT (its emulator)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from harness.cosmos_command import LOOSE, SCENARIOS
from run_tower import RunTower
from tower import Tower
from tower.fixtures import need_tower

pytestmark = [pytest.mark.root, pytest.mark.nightly]

SCENARIO = SCENARIOS / "thesis" / "hwil_counter.yaml"
BOARDS = 24
HOME = "pi22"
HAT = {"name": "hat", "kind": "sense_hat", "rate_hz": 20, "parameters": {"emulated": True}}
FEEDER = """
import importlib, time
from sense_emu.lock import EmulatorLock
EmulatorLock("sense_emu").acquire()
servers = []
for name, values in (("humidity", (40.0, 30.0)), ("pressure", (1013.0, 30.0))):
    kind = getattr(importlib.import_module(f"sense_emu.{name}"), f"{name.title()}Server")
    server = kind(simulate_noise=False)
    server.set_values(*values)
    servers.append(server)
servers.append(importlib.import_module("sense_emu.imu").IMUServer(simulate_world=False))
print("fed", flush=True)
time.sleep(3600)
"""
"""Takes the place of the emulator's window on the board: at rest, at 30 degC."""
START = """
set -- ~/cosmos/environments/*/lib/python3*/site-packages/sense_emu
cd /tmp
setsid nohup "${1%/lib/*}/bin/python" feeder.py > fed 2>&1 < /dev/null &
for i in $(seq 300); do grep -q fed /tmp/fed && exit 0; sleep 0.1; done
cat /tmp/fed
exit 1
"""
DURATION_S = 20


@pytest.fixture
def tower(tmp_path: Path) -> Iterator[RunTower]:
    need_tower()
    with Tower(count=BOARDS) as boards:
        made = RunTower(boards, tmp_path, tmp_path / "cache")
        made.boards = tuple(boards.boards)
        boards.write_inventory(made.inventory, {HOME: {"cosmos_devices": [HAT]}})
        yield made


def rows(folder: Path) -> list[dict[str, Any]]:
    """Return the device samples that the host recorded, as mappings."""
    head, *lines = (folder / "host" / "device_samples.jsonl").read_text().splitlines()
    names = [field["name"] for field in json.loads(head)["fields"]]
    found = (json.loads(line) for line in lines)
    return [dict(zip(names, line, strict=True)) for line in found if isinstance(line, list)]


def test_the_hat_of_one_of_24_boards_is_read_while_all_count(tower: RunTower) -> None:
    up = tower.cosmos("up", "-i", tower.inventory, SCENARIO, patience_s=600)
    assert up.returncode == 0, up.stdout + up.stderr
    tower.tower.run(HOME, f"cat > /tmp/feeder.py << 'END'\n{FEEDER}END")
    fed = tower.tower.run(HOME, START, timeout_s=90, check=False)
    assert fed.returncode == 0, fed.stdout

    code, document = tower.cosmos.run(
        SCENARIO,
        f"time.duration_s={DURATION_S}",
        *LOOSE,
        "hardware.stale_ratio=1",
        "hardware.lost=1000",
        "vars.late_ms_max=60000",
        "vars.samples_hz_min=1",  # 24 boards and their host share this machine's processors
        options=("--no-report", "-i", tower.inventory),
    )
    folder = tower.cosmos.directory(document)

    assert code == 0, document["verdict"]
    assert (document["data"]["missing"], document["agents"]["lost"]) == ([], [])
    assert len(list((folder / "agents").iterdir())) == BOARDS
    assert {path.name for path in (folder / "devices").iterdir()} == {HOME}
    found = rows(folder)
    assert {row["device"] for row in found} == {"agent-22/hat"}
    newest = {row["channel"]: row["values"] for row in found}
    assert {"gyroscope", "accelerometer", "magnetometer"} <= set(newest)
    assert newest["temperature"] == pytest.approx(30.0, abs=0.5)
    assert newest["pressure"] == pytest.approx(1013.0, abs=5.0)
    hat = document["devices"][f"{HOME}/hat"]
    assert hat["samples"] > DURATION_S
    assert document["simulation"]["host"]["device_samples"] == {"agent-22": len(found)}
    assert tower.living() == {}
