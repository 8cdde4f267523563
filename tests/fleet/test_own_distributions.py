"""Distributions of one's own, a folder and a wheel that a scenario requires by path, on boards that no index serves them."""

from __future__ import annotations

import base64
import hashlib
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from run_tower import PATIENT, RunTower

PROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]

[project]
name = "cars"
version = "0.1"
"""
BACKEND = r"""
import base64, hashlib, zipfile
from pathlib import Path

def get_requires_for_build_wheel(settings=None):
    return []

def build_wheel(folder, settings=None, metadata=None):
    info = "cars-0.1.dist-info"
    content = {
        "cars.py": Path("cars.py").read_bytes(),
        f"{info}/METADATA": b"Metadata-Version: 2.1\nName: cars\nVersion: 0.1\nRequires-Dist: motor\n",
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": b"[madns.simulations]\ncars = cars:simulation\n",
    }
    write_wheel(Path(folder, "cars-0.1-py3-none-any.whl"), info, content)
    return "cars-0.1-py3-none-any.whl"

def write_wheel(path, info, content):
    rows = []
    with zipfile.ZipFile(path, "w") as wheel:
        for name, data in content.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
            rows.append(f"{name},sha256={digest},{len(data)}\n")
            wheel.writestr(name, data)
        wheel.writestr(f"{info}/RECORD", "".join([*rows, f"{info}/RECORD,,\n"]))
"""
CARS = """
from dataclasses import dataclass
import motor
from madns_runtime.plugin.api import AgentSimulation, Simulation

COLOUR = "red"

@dataclass(frozen=True)
class Parameters:
    pass

class Car(AgentSimulation):
    def finish(self):
        return {"colour": COLOUR, "motor": motor.POWER_KW}

simulation = Simulation(name="cars", parameters=Parameters, agent=":Car")
"""
CHANGES = {
    "simulation": "cars",
    "requirements": ["./cars", "./dist/motor-0.2-py3-none-any.whl"],
    "agents": {"count": 2, "tick_hz": 5},
    "time": {"duration_s": 2, "rtf_tolerance": 0.9},
    "timeouts": PATIENT,
}


def make_distributions(folder: Path) -> None:
    (folder / "cars").mkdir()
    (folder / "dist").mkdir()
    (folder / "cars/pyproject.toml").write_text(PROJECT)
    (folder / "cars/backend.py").write_text(BACKEND)
    (folder / "cars/cars.py").write_text(CARS)
    info = "motor-0.2.dist-info"
    content = {
        "motor.py": b"POWER_KW = 75\n",
        f"{info}/METADATA": b"Metadata-Version: 2.1\nName: motor\nVersion: 0.2\n",
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    rows = []
    with zipfile.ZipFile(folder / "dist/motor-0.2-py3-none-any.whl", "w") as wheel:
        for name, data in content.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
            rows.append(f"{name},sha256={digest},{len(data)}\n")
            wheel.writestr(name, data)
        wheel.writestr(f"{info}/RECORD", "".join([*rows, f"{info}/RECORD,,\n"]))


def install_here(operator: RunTower) -> None:
    target = operator.folder / "installed"
    sources = [operator.scenarios / "cars", *(operator.scenarios / "dist").iterdir()]
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--upgrade"]
    subprocess.run(
        [*command, "--target", str(target), *map(str, sources)],
        check=True,
        timeout=300,
        stdin=subprocess.DEVNULL,
    )
    operator.environment["PYTHONPATH"] = str(target)


def seen_by_agents(operator: RunTower) -> str:
    """Return what the agents' half said at its end, as run.json has it."""
    return json.dumps(operator.document["simulation"], sort_keys=True)


@pytest.mark.root
@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_boards_run_a_registered_simulation_of_a_folder_and_get_it_again_when_it_has_changed(
    make_tower, tmp_path: Path
) -> None:
    operator = RunTower(make_tower(count=2), tmp_path, tmp_path / "cache")
    operator.choose()
    make_distributions(operator.scenarios)
    scenario = operator.scenario(**CHANGES)

    missing = operator.cosmos("validate", scenario)
    assert missing.returncode == 2
    assert "cars is not installed on this computer; install it here as well" in missing.stderr
    assert f"pip install {operator.scenarios}/cars" in missing.stderr

    install_here(operator)
    up = operator.cosmos("up", "-i", operator.inventory, scenario)
    assert "2 machines: 2 changed, 0 ok, 0 failed" in up.stdout, up.stdout + up.stderr
    operator.start(**CHANGES)
    assert operator.finish() == 0, operator.talk
    assert '"colour": "red", "motor": 75' in seen_by_agents(operator)

    again = operator.cosmos("up", "-i", operator.inventory, scenario)
    assert "2 machines: 0 changed, 2 ok, 0 failed" in again.stdout, again.stdout + again.stderr

    cars = operator.scenarios / "cars/cars.py"
    cars.write_text(CARS.replace('"red"', '"blue"'))
    install_here(operator)
    operator.start(**CHANGES)
    assert operator.finish() == 3, operator.talk
    assert "run `cosmos up -i" in operator.talk
    changed = operator.cosmos("up", "-i", operator.inventory, scenario)
    assert "2 machines: 2 changed, 0 ok, 0 failed" in changed.stdout, changed.stdout
    operator.start(**CHANGES)
    assert operator.finish() == 0, operator.talk
    assert '"colour": "blue", "motor": 75' in seen_by_agents(operator)
