"""A device that a run has open is refused to the next one, by name, until the last process that has it is gone."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
from pathlib import Path
from typing import Any

import pytest
import yaml
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.waiting import wait_until

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import MachineError
from madns_runtime.hardware import claims
from madns_runtime.hardware.claims import DeviceClaims, claim_path
from madns_runtime.hardware.contract import Channel, DeviceKind
from madns_runtime.hardware.kind_registry import prepare
from tests.hardware.bench import line_bench

DEVICE = DeviceLaunch(
    name="imu",
    place="pi22",
    kind="serial",
    base_directory="/x",
    rate_hz=1.0,
    parameters={"port": "/dev/ttyUSB0"},
    users=("agent-01",),
)
KIND = DeviceKind(name="serial", summary="a line", channels=(Channel(name="level"),))
PATIENCE_S = 90.0


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(claims, "WAIT_S", 0.0)
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))


def test_a_second_claim_is_refused_and_names_the_first() -> None:
    first, second = DeviceClaims("0007-hwil"), DeviceClaims("0008-hwil")
    first.claim(DEVICE, KIND)

    with pytest.raises(
        MachineError, match=rf"device pi22/imu is in use by run 0007-hwil \(pid {os.getpid()}\)"
    ):
        second.claim(DEVICE, KIND)

    first.release()
    second.claim(DEVICE, KIND)
    second.release()


def test_other_devices_are_other_claims() -> None:
    other_port = dataclasses.replace(DEVICE, parameters={"port": "/dev/ttyUSB1"})
    other_folder = dataclasses.replace(DEVICE, base_directory="/y", rate_hz=5.0)

    assert claim_path(other_port) != claim_path(DEVICE)
    assert claim_path(other_folder) == claim_path(DEVICE)


MAP = {"registers": [{"name": "level", "address": 1}]}
LINES = [{"name": "door", "offset": 4}, {"name": "lamp", "offset": 5}]
SAME: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "i2c": ({"map": MAP, "address": 30}, {"map": MAP, "address": 31}, "i2c-1 0x1e"),
    "spi": ({"map": MAP}, {"map": MAP, "chip_select": 1}, "spidev0.0"),
    "pwm": ({"line": 1}, {"line": 0}, "/sys/class/pwm/pwmchip0/pwm1"),
    "gpio": ({"lines": LINES}, {"lines": [{"name": "x", "offset": 6}]}, "/dev/gpiochip0 line 4"),
    "analog": (
        {"inputs": [{"name": "v", "file": "out_voltage0_raw", "is_output": True}]},
        {"inputs": [{"name": "v", "file": "out_voltage1_raw", "is_output": True}]},
        "/sys/bus/iio/devices/iio:device0/out_voltage0_raw",
    ),
}


@pytest.mark.parametrize("kind", SAME)
def test_the_same_chip_under_another_name_is_refused_and_another_one_is_not(kind: str) -> None:
    given, other_given, part = SAME[kind]

    def claim(by: DeviceClaims, name: str, parameters: dict[str, Any]) -> None:
        launch = dataclasses.replace(DEVICE, name=name, kind=kind, parameters=parameters)
        program = prepare(kind, parameters, Path())
        by.claim(launch, program.kind, program.needs.exclusive)

    first, second = DeviceClaims("0007-hwil"), DeviceClaims("0008-hwil")
    claim(first, "imu", given)
    claim(first, "again", given)  # one run may have a chip by two names
    told = f"device pi22/mine: {re.escape(part)} is in use by run 0007-hwil .* as pi22/imu: end it"
    with pytest.raises(MachineError, match=told):
        claim(second, "mine", given)
    claim(second, "mine", other_given)

    first.release()
    claim(second, "mine", given)
    second.release()


def test_kinds_that_need_no_hardware_are_open_to_all() -> None:
    synthetic = dataclasses.replace(KIND, needs_hardware=False)
    for _ in range(2):
        DeviceClaims("a").claim(DEVICE, synthetic)

    assert not claim_path(DEVICE).exists()


def test_a_damaged_claim_names_nobody(tmp_path: Path) -> None:
    first = DeviceClaims("a")
    first.claim(DEVICE, KIND)
    claim_path(DEVICE).write_text("no json")

    with pytest.raises(MachineError, match="in use by another run"):
        DeviceClaims("b").claim(DEVICE, KIND)
    first.release()


def test_where_claims_cannot_be_kept_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSMOS_STATE_DIR", "/proc/nowhere")
    own = DeviceClaims("a")

    own.claim(DEVICE, KIND)

    assert own.problem.startswith("other runs are not kept from its devices: ")


def is_free(device: DeviceLaunch) -> bool:
    """Tell whether another run would get the device."""
    other = DeviceClaims("b")
    try:
        other.claim(device, KIND)
    except MachineError:
        return False
    other.release()
    return True


@pytest.mark.process
@pytest.mark.parametrize("is_guarded", [False, True])
def test_a_claim_outlives_its_supervisor_in_what_may_open_the_device(
    tmp_path: Path, is_guarded: bool
) -> None:
    with line_bench(tmp_path, launch={"may_move": is_guarded}) as (bench, _):
        (device,) = bench.manager._launch.devices
        bench.until(lambda: bench.hardware["line"].status == "ok")

        bench.manager._claims.release()  # as the supervisor's end does
        assert not is_free(device)
        os.kill(bench.pid_of(), signal.SIGKILL)
        os.waitid(os.P_PID, bench.pid_of(), os.WEXITED | os.WNOWAIT)
        assert is_free(device) is not is_guarded  # the guardian is about to open it

        bench.close()
        wait_until(lambda: is_free(device))


DRIVER = """
import time
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample

class Gauge(Device):
    kind = DeviceKind(name="gauge", summary="a gauge", channels=(Channel(name="level"),), rate_hz=2.0)
    def read(self):
        return Sample(values={"level": 1.0}, taken_s=time.monotonic())
"""


@pytest.mark.process
def test_a_second_run_and_a_test_of_a_device_in_use_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "gauge.py").write_text(DRIVER)
    machine = {
        "ansible_connection": "local",
        "cosmos_devices": [{"name": "gauge", "kind": "./gauge.py:Gauge"}],
    }
    inventory = tmp_path / "here.yaml"
    inventory.write_text(yaml.safe_dump({"all": {"hosts": {"here": machine}}}))
    scenario = tmp_path / "use.yaml"
    scenario.write_text(
        "name: use\nsimulation: counter\nagents: {count: 1, tick_hz: 10}\ntime: {duration_s: 300}\n"
        "hardware: {use: [{devices: [gauge]}], on_device_loss: continue}\n"
    )
    cosmos = CosmosCommand(tmp_path)
    first = cosmos.start_run(scenario, *LOOSE, options=("--no-report", "-i", inventory))
    try:
        samples = tmp_path / "runs/0001-use/devices/here/gauge/level.jsonl"
        wait_until(lambda: samples.exists(), patience_s=PATIENCE_S)

        tried = cosmos("devices", "test", "-i", inventory, "--seconds", "1")
        second = cosmos("run", scenario, "-i", inventory, "--no-report", "--json", "--quiet")
    finally:
        first.send_signal(signal.SIGINT)
        first.communicate(timeout=PATIENCE_S)

    assert tried.returncode == 3
    assert "device here/gauge is in use by run 0001-use (pid " in tried.stderr
    assert second.returncode == 1, second.stderr
    assert "device here/gauge is in use by run 0001-use (pid " in second.stderr
    assert "device here/gauge is in use by run 0001-use (pid " in second.stdout  # its run.json
    after = cosmos("devices", "test", "-i", inventory, "--seconds", "3")
    assert after.returncode == 0, after.stderr
