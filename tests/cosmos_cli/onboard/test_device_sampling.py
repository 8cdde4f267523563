"""Devices driven by the helper on a machine: bounds, deadlines, and nothing that goes on without who asked."""

import contextlib
import os
import sys
from pathlib import Path

import pytest
from harness.waiting import wait_until

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.remote_sampling import PARTS, VERB, checked_devices, read_answer
from madns_runtime.config import DeviceLaunch, to_mapping

pytestmark = pytest.mark.process

PATIENCE_S = 60.0
DRIVER = """
import os, time
from dataclasses import dataclass
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample

@dataclass(frozen=True, kw_only=True)
class ValveParameters:
    folder: str

class Valve(Device):
    kind = DeviceKind(name="valve", summary="a valve", parameters=ValveParameters, rate_hz=50.0,
        channels=(Channel(name="level"), Channel(name="duty", direction="out", safe=0.0)))
    def open(self):
        self.note("pid", str(os.getpid()))
        return "v-1"
    def read(self):
        return Sample(values={"level": 1.0}, taken_s=time.monotonic())
    def make_safe(self):
        self.note("safe", "yes")
    def write(self, values, due_s):
        self.note("wrote", "yes")
    def note(self, name, text):
        with open(f"{self.parameters.folder}/{name}", "w") as file:
            file.write(text)
"""


@pytest.fixture
def board(tmp_path):
    target = Target(name="pi01", address="127.0.0.1", connection="local", root=str(tmp_path))
    with Helper.start(LocalConnection(target), PARTS) as helper:
        yield helper


def launch(folder):
    (folder / "valve.py").write_text(DRIVER)
    return DeviceLaunch(
        name="valve",
        place="pi01",
        kind="./valve.py:Valve",
        base_directory=str(folder),
        rate_hz=50.0,
        parameters={"folder": str(folder)},
        users=("cosmos-devices",),
        owner="cosmos-devices",
    )


def asked(folder, *, seconds, timeout_s=PATIENCE_S, has_records=False, python=sys.executable):
    (folder / "state").mkdir(exist_ok=True)
    variables = {"PYTHONPATH": os.pathsep.join(sys.path), "COSMOS_STATE_DIR": str(folder / "state")}
    order = {"devices": [to_mapping(launch(folder))], "seconds": seconds, "writes": False}
    return {
        "python": python,
        "variables": variables,
        "directory": str(folder / "state"),
        "timeout_s": timeout_s,
        "has_records": has_records,
        "order": order,
    }


def folders(folder):
    return list((folder / "state").glob("devices-*"))


def test_a_device_is_driven_and_its_records_are_brought(board, tmp_path):
    old = tmp_path / "state" / "devices-old"
    old.mkdir(parents=True)
    os.utime(old, (0, 0))

    told, _ = read_answer(
        board.pieces(VERB, asked(tmp_path, seconds=3, has_records=True), whole_s=PATIENCE_S),
        tmp_path / "records",
    )

    device = checked_devices(told, [launch(tmp_path)])["pi01/valve"]
    assert device["status"] in ("ok", "stale")  # as a busy machine may have it at the end
    assert (device["identity"], device["errors"]) == ("v-1", 0)
    assert device["channels"]["level"]["samples"] > 2
    assert (tmp_path / "records/devices/pi01/valve/level.jsonl").stat().st_size > 0
    assert not (tmp_path / "wrote").exists()
    assert folders(tmp_path) == []


def test_what_does_not_end_in_time_is_ended(board, tmp_path):
    with pytest.raises(MachineFailure) as caught:
        list(board.pieces(VERB, asked(tmp_path, seconds=600, timeout_s=3), whole_s=PATIENCE_S))

    assert caught.value.kind is FailureKind.TIMEOUT
    assert "did not end within 3 s" in caught.value.text
    assert folders(tmp_path) == []


def test_devices_are_closed_when_nobody_listens_any_more(board, tmp_path):
    pieces = board.pieces(VERB, asked(tmp_path, seconds=600), whole_s=PATIENCE_S)
    noted = tmp_path / "pid"
    # The file is there a moment before what stands in it.
    pid = int(
        wait_until(
            lambda: next(pieces) is not None and noted.exists() and noted.read_text(),
            patience_s=PATIENCE_S,
        )
    )

    board.close()

    wait_until(lambda: not Path(f"/proc/{pid}").exists(), patience_s=PATIENCE_S)
    wait_until(lambda: folders(tmp_path) == [], patience_s=PATIENCE_S)


def test_a_machine_without_its_interpreter_says_what_to_do(board, tmp_path):
    with (
        pytest.raises(MachineFailure, match="no such program") as caught,
        contextlib.closing(
            board.pieces(VERB, asked(tmp_path, seconds=1, python="/nowhere/python"))
        ) as pieces,
    ):
        list(pieces)

    assert "cosmos up" in caught.value.advice
