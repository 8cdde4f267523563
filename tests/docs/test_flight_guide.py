"""The guide to flight software: its example runs as it stands, and its tables are complete."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from guides import ROOT, blocks, row_keys, spans

from madns_runtime.simulations.constellation.flight import process
from madns_runtime.simulations.constellation.flight.answers import KEYS
from madns_runtime.simulations.constellation.flight.api import FlightContext, FlightSoftware
from madns_runtime.simulations.constellation.flight.loading import METHODS
from madns_runtime.simulations.constellation.parameters import SensorNoise, Sensors
from madns_runtime.simulations.constellation.vehicle import board, commands

GUIDE = (ROOT / "docs" / "flight-software.md").read_text("utf-8")


@pytest.mark.process
def test_the_example_runs_as_it_stands(tmp_path):
    (tmp_path / "climb.yaml").write_text(blocks(GUIDE, "yaml")[0])
    (tmp_path / "guidance.py").write_text(blocks(GUIDE, "python")[0])
    lines = blocks(GUIDE, "sh")[0].splitlines()
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

    for line in lines:
        done = subprocess.run(
            line.split(),
            cwd=tmp_path,
            env={**os.environ, "PATH": path, "COSMOS_RUNS": str(tmp_path / "runs")},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr

    run = next(path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    agents = json.loads((run / "run.json").read_text())["simulation"]["agents"]
    assert [agent["flight"] for agent in agents.values()] == [{"commands": True}] * 2
    estimates = (run / "agents" / "agent-01" / "estimates.jsonl").read_text().splitlines()
    reached_m = [row[1] for row in map(json.loads, estimates) if isinstance(row, list)][-50:]
    # The noise of 1 mm/s in velocity is 2 m in the semi-major axis.
    assert sum(reached_m) / len(reached_m) == pytest.approx(7_160_000, abs=10.0)


def test_its_tables_name_all_methods_and_sensors():
    def names(heading):
        return {key.partition("(")[0] for key in row_keys(GUIDE, heading)}

    public = {name for name in vars(FlightContext) if not name.startswith("_")}
    assert names("## The class") == set(METHODS) | public
    assert {name for name in vars(FlightSoftware) if not name.startswith("_")} == set(METHODS)
    assert names("## Readings") == {field.name for field in dataclasses.fields(Sensors)}
    for field in (
        *FlightContext.__annotations__,
        *(f.name for f in dataclasses.fields(SensorNoise)),
    ):
        assert field in spans(GUIDE), field


def test_its_json_lines_are_those_of_the_program():
    setup, tick, answer = (
        json.loads(line) for block in blocks(GUIDE, "json") for line in block.splitlines()
    )

    assert list(setup) == ["setup"]
    assert list(tick) == ["t_s", "readings", "messages", "results"]
    assert set(answer) == KEYS - {"t_s"}


def test_its_bounds_are_those_of_the_code():
    assert f"At most {commands.COMMANDS_PER_TICK_MAX} commands" in GUIDE
    assert f"{board.MESSAGES_PER_TICK_MAX} messages a tick" in GUIDE
    assert f"{board.PAYLOAD_BYTES_MAX:,} bytes a message" in GUIDE
    assert f"{process.UNANSWERED_MAX} ticks unanswered" in GUIDE
    assert f"log, {process.LOG_LINES_MAX} lines at most" in " ".join(GUIDE.split())
