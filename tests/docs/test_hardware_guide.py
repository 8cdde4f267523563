"""The guide to hardware: what it shows runs as it stands, and its tables are complete."""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
from guides import ROOT, blocks, row_keys
from harness.waiting import wait_until

from cosmos_cli import app
from cosmos_cli.models.inventory.devices import MachineDevice
from madns_runtime.config import HardwareSettings
from madns_runtime.hardware import guardian, status
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.fault_actions import ACTIONS
from madns_runtime.hardware.kind_registry import registered_kinds, resolve_kind
from madns_runtime.simulations.constellation.equipment import Sensors

GUIDE = (ROOT / "docs" / "hardware.md").read_text("utf-8")
LOOSE = (
    "deadline.max_miss_ratio=1",
    "deadline.overrun_ms=1000",
    "time.rtf_tolerance=1",
    "timeouts.agents_ready_s=120",
    "timeouts.silence_s=30",
    "timeouts.complete_s=60",
    "hardware.stale_ratio=1",
    "hardware.lost=100",
    "hardware.on_device_loss=continue",
)
"""So that a busy machine breaks nothing of the example."""


def written(folder):
    """Write all that the guide shows into a folder, and return the commands of its two examples."""
    driver = next(block for block in blocks(GUIDE, "python") if "class Load" in block)
    (folder / "load.py").write_text(driver)
    inventory, *scenarios = blocks(GUIDE, "yaml")
    (folder / "here.yaml").write_text(inventory)
    for text in scenarios:
        (folder / f"{text.split()[1]}.yaml").write_text(text)
    return [block.splitlines() for block in blocks(GUIDE, "sh")]


def test_a_device_that_is_a_model_is_one_as_it_stands(tmp_path):
    (text,) = (block for block in blocks(GUIDE, "python") if "class Swing" in block)
    (tmp_path / "swing.py").write_text(text)

    kind = resolve_kind("./swing.py:Swing", tmp_path)
    values = [kind.device(None).sample_at(t_s).values["angle"] for t_s in (0.0, 0.5, 1.5)]

    assert kind.follows_simulated_time
    assert values == pytest.approx([0.0, 30.0, -30.0])


@pytest.mark.parametrize("cls", [DeviceKind, Channel, Needs], ids=lambda cls: cls.__name__)
def test_its_tables_name_all_that_a_kind_declares(cls):
    table = GUIDE.split(f"\n| `{cls.__name__}` |")[1].split("\n\n")[0]
    rows = re.findall(r"^\| (`[^|]*`) \|", table, flags=re.MULTILINE)

    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == {
        field.name for field in dataclasses.fields(cls)
    }


def test_kind_null_is_named_as_the_guide_writes_it(tmp_path, capsys):
    written = 'kind: "null"'
    text = (
        "name: a\nsimulation: counter\nagents: {count: 1}\nhardware: {devices: [{name: d, %s}]}\n"
    )
    assert f"`{written}`" in GUIDE

    for kind, code, told in (
        (written, 0, ""),
        ("kind: null", 2, 'got null; the text is written in quotes: "null"'),
    ):
        (tmp_path / "a.yaml").write_text(text % kind)
        assert app.run(["validate", str(tmp_path / "a.yaml")]) == code
        assert told in capsys.readouterr().err


def start(folder, line, *settings, stdout=subprocess.DEVNULL):
    """Start a command in a folder; records go to runs there."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.Popen(
        [*line.split(), *(part for each in settings for part in ("--set", each))],
        cwd=folder,
        env={
            **os.environ,
            "PATH": path,
            "COSMOS_RUNS": str(folder / "runs"),
            "COSMOS_STATE_DIR": str(folder / "state"),
        },
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
    )


def cosmos(folder, line, *settings):
    """Run a command to its end, which must be a good one."""
    with start(folder, f"{line} --no-report", *settings) as process:
        try:
            _, err = process.communicate(timeout=300)
        except BaseException:
            process.kill()
            raise
    assert process.returncode == 0, err


def samples(folder, run):
    """Return the device samples that the host recorded, without who read them and how late they came."""
    path = folder / "runs" / run / "host" / "device_samples.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return {line[1]: [] for line in lines if isinstance(line, list)}, lines


@pytest.mark.process
def test_the_driver_of_ones_own_runs_as_it_stands(tmp_path):
    (command,), *_ = written(tmp_path)

    cosmos(tmp_path, command, *LOOSE)

    sources, lines = samples(tmp_path, "0001-watch")
    assert set(sources) == {"agent-01/load"}
    assert len(lines) > 5
    events = tmp_path / "runs" / "0001-watch" / "devices" / "here" / "load" / "events.jsonl"
    assert '"loadavg"' in events.read_text()


@pytest.mark.process
def test_faults_are_inserted_into_the_example_as_the_guide_says(tmp_path):
    (command,), *_ = written(tmp_path)
    orders = re.findall(r"^    (cosmos inject .*)$", GUIDE, flags=re.MULTILINE)
    assert len(orders) == 2

    with start(tmp_path, f"{command} --set time.duration_s=600", *LOOSE) as running:
        try:
            events = tmp_path / "runs" / "0001-watch" / "devices" / "here" / "load" / "events.jsonl"
            wait_until(lambda: events.is_file() and "opened" in events.read_text())
            for order in orders:
                wait_until(lambda order=order: start(tmp_path, order).wait(60) == 0)
            wait_until(lambda: "clear" in events.read_text())
        finally:
            running.send_signal(signal.SIGINT)
            running.communicate(timeout=120)
    faults = [json.loads(line) for line in events.read_text().splitlines() if "bias" in line]
    assert len(faults) == 1


@pytest.mark.process
def test_devices_are_verified_listed_tried_and_recorded_as_the_guide_says(tmp_path):
    written(tmp_path)
    commands = re.findall(
        r"^    (cosmos devices .*(?:here\.yaml|load\.py).*)$", GUIDE, flags=re.MULTILINE
    )
    assert len(commands) == 4

    for command in commands:
        with start(tmp_path, command) as process:
            _, err = process.communicate(timeout=240)
        assert process.returncode == 0, err

    assert '"load"' in (tmp_path / "recorded" / "load" / "load.jsonl").read_text()


def test_the_driver_has_thirty_lines():
    driver = next(block for block in blocks(GUIDE, "python") if "class Load" in block)

    assert len([line for line in driver.splitlines() if line.strip()]) <= 30


@pytest.mark.process
def test_what_was_recorded_in_lockstep_is_played_back_to_all(tmp_path):
    _, commands, *_ = written(tmp_path)

    for command in commands:
        cosmos(tmp_path, command)

    sources, lines = samples(tmp_path, "0002-again")
    assert set(sources) == {"agent-01/gyro", "agent-02/gyro"}
    first = [line for line in samples(tmp_path, "0001-waves")[1] if isinstance(line, list)]
    told = [line[5] for line in first if line[1] == "agent-01/gyro"]
    again = [line[5] for line in lines if isinstance(line, list) and line[1] == "agent-02/gyro"]
    assert len(again) > 50
    assert set(again) <= set(told)


@pytest.mark.process
def test_the_vehicle_with_a_gyroscope_on_the_desk_is_flown_and_its_device_calibrated(tmp_path):
    *_, (run,), (calibrate,) = written(tmp_path)

    cosmos(tmp_path, run)
    with start(tmp_path, f"{calibrate} --json", stdout=subprocess.PIPE) as process:
        out, err = process.communicate(timeout=240)

    assert process.returncode == 0, err
    found = json.loads(out)["sensors"][0]
    for value, sigma, truth in zip(
        found["bias"]["values"], found["bias"]["sigmas"], (0.8, -0.3, 0.05), strict=True
    ):
        assert abs(value - truth) < 5 * sigma < 0.05
    folder = tmp_path / "runs" / "0001-measured" / "agents" / "agent-01"
    for name in ("gyro", "gyro_truth", "gyro_model"):
        lines = (folder / f"{name}.jsonl").read_text().splitlines()
        # 10 Hz for 30 s, with a schema before and an end behind them.
        assert len(lines) == 302, name


def test_its_table_of_measurements_names_all_sensors_and_counts():
    of_sensors, of_counts = (
        GUIDE.split(f"\n| {head} |")[1].split("\n\n")[0]
        for head in ("sensor | channel", "count | of")
    )
    keys = [
        re.findall(r"^\| `(\w+)`", table, flags=re.MULTILINE) for table in (of_sensors, of_counts)
    ]
    assert set(keys[0]) == {field.name for field in dataclasses.fields(Sensors)}
    assert keys[1] == ["samples", "skipped", "absent", "refused", "unpaired", "without_truth"]


def test_its_tables_name_all_settings_and_kinds():
    assert set(row_keys(GUIDE, "## Seen on what")) == set(registered_kinds())
    fields = {field.name for field in dataclasses.fields(HardwareSettings)}
    who = GUIDE.split("\n## Who uses what\n")[1].split("| status |")[0]
    assert set(row_keys(f"\n## Who\n{who}", "## Who")) == fields
    assert {name for name in ACTIONS if f"`{name}`" not in GUIDE} == set()
    assert all(field.name in GUIDE for field in dataclasses.fields(MachineDevice))


@pytest.mark.parametrize("name", registered_kinds())
def test_each_kind_has_its_parameters_in_the_guide(name):
    parameters = resolve_kind(name, ROOT).parameters

    section = GUIDE.split(f"\n### {name}\n", 1)[1].split("\n### ", 1)[0]
    first = section.split("\n\n`")[0]
    listed = set(row_keys(f"\n## Kind\n{first}", "## Kind"))
    assert listed == {field.name for field in dataclasses.fields(parameters)}


def classes_of(kind):
    """Yield a parameters class, and those of its fields, with the types of their fields."""
    hints = get_type_hints(kind)
    yield kind, hints
    for hint in hints.values():
        for inner in (hint, *get_args(hint)):
            if isinstance(inner, type) and dataclasses.is_dataclass(inner):
                yield from classes_of(inner)


@pytest.mark.parametrize("name", registered_kinds())
def test_its_tables_have_the_kinds_own_defaults_and_choices(name):
    section = GUIDE.split(f"\n### {name}\n", 1)[1].split("\n### ", 1)[0]
    wrong = []
    for cls, hints in classes_of(resolve_kind(name, ROOT).parameters):
        table = section.split(f"\n`{cls.__name__}`, of", 1)[-1].split("\n| parameter ", 1)[1]
        cells = {
            row.split("`")[1]: row.split(" | ")
            for row in table.split("\n\n")[0].strip().split("\n")[2:]
        }
        for field in dataclasses.fields(cls):
            _, kind, default, *_ = cells[field.name]
            number = field.default
            if isinstance(number, int | float) and not isinstance(number, bool):
                wrong += [field.name] * (float(default.strip("`")) != number)
            if get_origin(hints[field.name]) is Literal:
                wrong += [w for w in get_args(hints[field.name]) if f"`{w}`" not in kind]
    assert wrong == []


def test_its_limits_are_those_of_the_code():
    assert (
        f"older than {status.STALE_PERIODS:g} periods, and than {status.STALE_S_MIN:g} s" in GUIDE
    )
    assert f"for {status.LOST_PERIODS:g} periods, and {status.LOST_S_MIN:g} s" in GUIDE
    assert f"after {status.BACK_OFF_S_MIN:g} s at first and {status.BACK_OFF_S_MAX:g} s" in GUIDE
    assert f"within {guardian.GRACE_S:g} s of its owner's" in GUIDE
