"""`cosmos devices calibrate`: guided on a device, and from recordings; what it prints is what a scenario takes."""

from __future__ import annotations

import io
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cosmos_cli.app import run as cosmos
from cosmos_cli.commands import devices_calibrate
from cosmos_cli.launch.calibration import field_at_t
from madns_runtime.config import from_mapping
from madns_runtime.simulations.constellation.equipment import Sensors

Told = Callable[..., tuple[int, dict[str, Any]]]

INVENTORY = """
all:
  hosts:
    here:
      ansible_connection: local
      cosmos_devices:
        - name: imu
          kind: synthetic
          rate_hz: 100
          parameters:
            channels:
              - {name: rate, unit: deg/s, components: [x, y, z], elements: [{offset: 0.8, noise: 0.05}, {noise: 0.05}, {noise: 0.05}]}
              - {name: force, unit: g, components: [x, y, z], elements: [{noise: 0.01}, {noise: 0.01}, {offset: 1.02, noise: 0.01}]}
              - {name: voltage, unit: V}
"""


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Told:
    """Calibrate with --json, and return the exit code and what was printed, or what was said."""

    def ask(*words: object) -> tuple[int, dict[str, Any]]:
        code = cosmos(["devices", "calibrate", *map(str, words), "--json"])
        captured = capsys.readouterr()
        return code, json.loads(captured.out) if code != 2 else {
            "said": captured.out + captured.err
        }

    return ask


def recording(folder: Path, values: Any, *, channel: str, unit: str) -> Path:
    """Write what `cosmos devices record` would."""
    folder.mkdir(parents=True)
    head = [("t_s", "s", "float"), ("number", "", "int"), ("age_us", "us", "int")]
    fields = [*head, *((f"{channel}_{axis}", unit, "float") for axis in "xyz")]
    keys = ("name", "unit", "kind")
    schema = {
        "schema": 1,
        "stream": channel,
        "shape": "array",
        "fields": [dict(zip(keys, field, strict=True)) for field in fields],
    }
    rows = [
        [number / 50, number, 10, *row] for number, row in enumerate(np.asarray(values).tolist())
    ]
    end = {"end": {"records": len(rows), "dropped": 0, "not_finite": 0}}
    lines = "\n".join(map(json.dumps, [schema, *rows, end]))
    (folder / f"{channel}.jsonl").write_text(lines + "\n")
    return folder


def noise(count: int, size: float) -> Any:
    return size * np.random.default_rng(count).standard_normal((count, 3))


def turned(strength: float) -> Any:
    ways = np.random.default_rng(0).standard_normal((300, 3))
    return strength * ways / np.linalg.norm(ways, axis=1, keepdims=True)


@pytest.mark.parametrize("device", ["imu", "here/imu"])
def test_a_recording_at_rest_gives_lines_that_a_scenario_takes(
    told: Told, tmp_path: Path, device: str
) -> None:
    values = np.array([0.5, -0.25, 0.0]) + noise(200, 0.02)
    folder = recording(tmp_path / "rest", values, channel="rate", unit="deg/s")

    code, found = told(device, "gyro", "--from", folder)

    assert code == 0
    (gyro,) = found["sensors"]
    assert gyro["bias"]["values"] == pytest.approx([0.5, -0.25, 0.0], abs=0.01)
    sensors = from_mapping(Sensors, yaml.safe_load(found["yaml"])["sensors"])
    assert sensors.gyro is not None and sensors.gyro.device == "imu.rate"  # type: ignore[union-attr]


@pytest.mark.parametrize("words", [(), ("--channel", "rate")])
def test_samples_of_all_processes_that_the_device_had_are_used(
    told: Told, tmp_path: Path, words: tuple[str, ...]
) -> None:
    folder = recording(tmp_path / "rest", noise(200, 0.02), channel="rate", unit="deg/s")
    head, *lines = (folder / "rate.jsonl").read_text().splitlines(keepends=True)
    (folder / "rate.jsonl").write_text("".join([head, *lines[:80]]))
    (folder / "rate.2.jsonl").write_text("".join([head, *lines[80:]]))
    (folder / "rate.3.jsonl").touch()  # of a process that was killed before it wrote

    code, found = told("imu", "gyro", "--from", folder, *words)

    assert code == 0, found
    assert (found["sensors"][0]["channel"], found["sensors"][0]["samples"]) == ("rate", 200)


def test_six_recordings_calibrate_an_accelerometer(told: Told, tmp_path: Path) -> None:
    options: list[object] = []
    for number, up in enumerate([*np.eye(3), *-np.eye(3)]):
        values = up * 1.05 + (0.02, 0.0, -0.03) + noise(60 + number, 0.002)
        folder = recording(tmp_path / str(number), values, channel="force", unit="g")
        options += ["--from", folder]

    code, found = told("imu", "accelerometer", *options)

    assert code == 0, found
    scale = np.array(found["sensors"][0]["scale"]["values"])
    assert scale == pytest.approx(1 / 1.05, abs=0.002)
    assert found["sensors"][0]["bias"]["values"] == pytest.approx(
        scale * (0.02, 0, -0.03), abs=0.002
    )


def test_a_turned_magnetometer_is_held_against_the_field_that_is_given(
    told: Told, tmp_path: Path
) -> None:
    values = 20.0 * turned(48.0) + (100.0, 0.0, -50.0)
    folder = recording(tmp_path / "turned", values, channel="field", unit="uT")

    code, found = told("imu", "magnetometer", "--from", folder, "--field-ut", 48)

    assert code == 0, found
    assert found["sensors"][0]["scale"]["values"] == pytest.approx([0.05] * 3, rel=1e-6)
    assert found["sensors"][0]["bias"]["values"] == pytest.approx([5.0, 0.0, -2.5], abs=1e-5)


def test_what_was_not_observable_is_told_and_ends_with_1(told: Told, tmp_path: Path) -> None:
    values = turned(48.0)
    values[:, 2] = 3.0
    folder = recording(tmp_path / "flat", values, channel="field", unit="uT")

    code, found = told("imu", "magnetometer", "--from", folder, "--field-ut", 48)

    assert (code, found["yaml"]) == (1, "")
    assert found["sensors"][0]["is_usable"] is False
    assert "about one axis, about z" in found["sensors"][0]["remarks"][0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("imu",), "give the inventory that lists it with -i, or --from"),
        ((), "expected DEVICE"),
        (("imu", "thermometer", "--from", "rest"), "expected one of gyro, accelerometer"),
        (("imu", "--from", "rest"), "expected one sensor behind the device's name"),
        (("imu", "gyro", "--from", "nowhere"), "expected a folder of a device's records"),
        (("imu", "gyro", "--from", "rest", "--from", "rest"), "at most 1 recordings, got 2"),
        (("imu", "magnetometer", "--from", "rest"), "no channel of three numbers in a unit of T"),
        (("imu", "gyro", "--from", "rest", "--channel", "rat"), "no input 'rat'"),
        (("imu", "magnetometer", "--from", "rest", "--place", "1,x"), "latitude and longitude"),
        (("imu", "gyro", "--from", "rest", "--field-ut", "0"), "field-ut"),
    ],
)
def test_what_does_not_fit_is_refused_in_words(
    told: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: Any, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    recording(tmp_path / "rest", noise(50, 0.02), channel="rate", unit="deg/s")

    code, found = told(*words)

    assert code == 2
    assert said in found["said"]


def test_the_options_of_calibration_are_of_no_other_action(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cosmos(["devices", "test", "--from", "rest", "-i", "none.yaml"]) == 2
    assert "are of calibrate alone" in capsys.readouterr().err


@pytest.mark.slow
def test_the_field_at_a_place_is_that_of_the_igrf() -> None:
    # Berlin: 49 to 50 uT through these decades.
    assert field_at_t("52.5,13.4") == pytest.approx(49.8e-6, abs=1e-6)
    assert field_at_t("52.5,13.4,80000") < field_at_t("52.5,13.4") * 0.97


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.process
def test_a_device_is_led_through_its_sensors(
    told: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inventory = tmp_path / "here.yaml"
    inventory.write_text(INVENTORY)
    monkeypatch.setattr(sys, "stdin", Terminal("\n\n"))
    monkeypatch.setattr(devices_calibrate, "POSITIONS", ("z up", "z up again"))

    # Long enough for the least number of samples on a busy computer, too.
    code, found = told("imu", "-i", inventory, "--seconds", 2.0)

    assert code == 1
    gyro, accelerometer = found["sensors"]
    assert gyro["is_usable"], gyro
    assert gyro["bias"]["values"] == pytest.approx([0.8, 0.0, 0.0], abs=0.05)
    assert (accelerometer["channel"], accelerometer["is_usable"]) == ("force", False)
    assert any("did not stand upright both ways" in text for text in accelerometer["remarks"])
    assert found["yaml"].splitlines()[1].startswith("  gyro: {device: imu.rate, bias: [0.")


@pytest.mark.process
def test_what_was_done_before_ctrl_c_is_shown_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    inventory = tmp_path / "here.yaml"
    inventory.write_text(INVENTORY)
    kept = tmp_path / "kept"
    kept.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(kept))

    def interrupt(*_words: object, **_more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(devices_calibrate, "wait_for_enter", interrupt)

    code = cosmos(["devices", "calibrate", "here/imu", "-i", str(inventory), "--seconds", "2.0"])

    printed = capsys.readouterr()
    assert code == 130
    assert "accelerometer of here/imu was interrupted: nothing of it is kept" in printed.err
    assert "gyro: {device: imu.rate" in printed.out
    assert "accelerometer: {" not in printed.out
    assert list(kept.iterdir()) == []


@pytest.mark.process
def test_positions_need_a_terminal(
    told: Told, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inventory = tmp_path / "here.yaml"
    inventory.write_text(INVENTORY)
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))

    code, found = told("imu", "accelerometer", "-i", inventory, "--seconds", 0.5)

    assert code == 2
    assert "give all of them with --from" in found["said"]


TREMBLING = """
import time
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample

class Gyro(Device):
    kind = DeviceKind(
        name="gyro", summary="a gyroscope that fails at times",
        channels=(Channel(name="rate", unit="deg/s", shape=(3,), components=("x", "y", "z")),),
    )
    reads = 0
    def read(self):
        self.reads += 1
        if self.reads % 20 == 0:
            raise OSError("the bus gave no answer")
        return Sample(values={"rate": (0.8, 0.0, 0.01 * (self.reads % 3))}, taken_s=time.monotonic())
"""


@pytest.mark.process
def test_a_device_that_failed_meanwhile_is_told_and_ends_its_calibration_with_1(
    told: Told, tmp_path: Path
) -> None:
    (tmp_path / "gyro.py").write_text(TREMBLING)
    inventory = tmp_path / "here.yaml"
    device = "{name: imu, kind: './gyro.py:Gyro', rate_hz: 100}"
    inventory.write_text(
        f"all: {{hosts: {{here: {{ansible_connection: local, cosmos_devices: [{device}]}}}}}}\n"
    )

    code, found = told("imu", "gyro", "-i", inventory, "--seconds", 2.0)

    assert code == 1, found
    assert found["sensors"][0]["is_usable"]
    (failure,) = found["failures"]
    assert failure.startswith("rest: Gyro.read raised OSError: the bus gave no answer")
