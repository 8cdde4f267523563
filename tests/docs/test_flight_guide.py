"""The guide to flight software: its example runs as it stands, and its tables are complete."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import typing
from pathlib import Path

import pytest
from guides import ROOT, blocks, row_keys, spans

from madns_runtime.recording import text_file
from madns_runtime.simulations.constellation import interface_settings
from madns_runtime.simulations.constellation.equipment import SensorNoise, Sensors
from madns_runtime.simulations.constellation.flight import asked_ticks, process
from madns_runtime.simulations.constellation.flight.api import FlightContext, FlightSoftware
from madns_runtime.simulations.constellation.flight.interface.content import BY_NUMBER
from madns_runtime.simulations.constellation.flight.interface.json_lines import KEYS
from madns_runtime.simulations.constellation.flight.interface.opening import PROTOCOLS
from madns_runtime.simulations.constellation.flight.loading import METHODS
from madns_runtime.simulations.constellation.vehicle import commands, flight_context

GUIDE = (ROOT / "docs" / "flight-software.md").read_text("utf-8")


def cosmos(folder, line):
    """Run a command in a folder; records go to runs there."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        line.split(),
        cwd=folder,
        env={**os.environ, "PATH": path, "COSMOS_RUNS": str(folder / "runs")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def summaries(folder):
    """Return what the agents of the newest run say at the end, and its folder."""
    run = max(path for path in (folder / "runs").iterdir() if path.is_dir())
    return json.loads((run / "run.json").read_text())["simulation"]["agents"].values(), run


def last_estimates(run, count):
    """Return the first agent's last estimates of its semi-major axis, m."""
    text = (run / "agents" / "agent-01" / "estimates.jsonl").read_text()
    rows = [row for row in map(json.loads, text.splitlines()) if isinstance(row, list)]
    return [row[1] for row in rows[-count:]]


@pytest.mark.process
def test_the_example_runs_as_it_stands(tmp_path):
    (tmp_path / "climb.yaml").write_text(blocks(GUIDE, "yaml")[0])
    (tmp_path / "guidance.py").write_text(blocks(GUIDE, "python")[0])

    for line in blocks(GUIDE, "sh")[0].splitlines():
        cosmos(tmp_path, line)

    agents, run = summaries(tmp_path)
    assert [agent["flight"] for agent in agents] == [{"commands": True}] * 2
    logged = GUIDE.partition("is in `runs/0001-climb/")[2].partition("`")[0]
    assert "command 0: accepted" in (run / logged).read_text()
    # The noise of 1 mm/s in velocity is 2 m in the semi-major axis.
    assert sum(last_estimates(run, 50)) / 50 == pytest.approx(7_160_000, abs=10.0)


@pytest.mark.process
def test_the_example_in_c_reaches_its_orbit(tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    scenario = ROOT / "scenarios" / "external_c.yaml"

    cosmos(tmp_path, f"cosmos run {scenario} --set time.mode=lockstep --duration 10")

    agents, run = summaries(tmp_path)
    assert [(a["flight"]["answers"], a["commands"]) for a in agents] == [(100, 1)] * 2
    assert sum(last_estimates(run, 50)) / 50 == pytest.approx(7_160_000, abs=10.0)


@pytest.mark.process
def test_the_three_flight_computers_damp_their_vehicles_rates(tmp_path):
    if shutil.which("cc") is None or shutil.which("c++") is None:
        pytest.skip("no C or C++ compiler")
    shutil.copy(ROOT / "scenarios/flight/flight_frames.h", tmp_path)
    said = {"yaml": "name: damp", "c": "flight_put", "cpp": "flight_put", "python": "binascii"}
    for language, words in said.items():
        ending = {"python": "py"}.get(language, language)
        (text,) = (block for block in blocks(GUIDE, language) if words in block)
        (tmp_path / f"damp.{ending}").write_text(text)

    for line in blocks(GUIDE, "sh")[1].splitlines():
        cosmos(tmp_path, line)

    agents, run = summaries(tmp_path)
    assert [agent["commands"] for agent in agents] == [20] * 3
    assert not any(sum(one["flight"]["interface"]["faults"].values()) for one in agents)
    for path in sorted((run / "agents").iterdir()):
        rows = [json.loads(line) for line in (path / "attitude.jsonl").read_text().splitlines()]
        first, *_, last = [row[5:] for row in rows if isinstance(row, list)]
        assert all(
            abs(after) < 0.1 * abs(before) for before, after in zip(first, last, strict=True)
        ), path


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
    assert list(tick) == ["t_s", "readings", "messages", "results", "refusals"]
    assert set(answer) == KEYS - {"t_s"}


def test_its_tables_of_interfaces_are_those_of_the_code():
    kinds = {
        typing.get_args(typing.get_type_hints(one)["kind"])[0]
        for one in typing.get_args(interface_settings.AnyTransport)
    }
    keys = set(row_keys(GUIDE, "## Where it really runs"))
    assert keys - {"file.py:Class"} == kinds | set(interface_settings.PROTOCOLS)
    assert set(PROTOCOLS) == set(interface_settings.PROTOCOLS)
    for one in BY_NUMBER.values():
        assert one.name in spans(GUIDE), one.name


def test_its_bounds_are_those_of_the_code():
    assert f"At most {commands.COMMANDS_PER_TICK_MAX} commands" in GUIDE
    assert f"{flight_context.MESSAGES_PER_TICK_MAX} messages per tick" in GUIDE
    assert f"{flight_context.PAYLOAD_BYTES_MAX:,} bytes per message" in GUIDE
    assert f"{asked_ticks.UNANSWERED_MAX} ticks unanswered" in GUIDE
    text = " ".join(GUIDE.split())
    assert f"`agents/NAME/{process.STDERR_TEXT}.txt`" in text
    assert f"{text_file.HEAD_BYTES >> 20} MiB and the last {text_file.TAIL_BYTES >> 10} KiB" in text
    assert f"`{process.LATE_CHECK}`" in GUIDE
