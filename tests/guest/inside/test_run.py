"""Whole runs of the counting benchmark with devices of five kinds on the guest's kernel, judged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import test_can
import test_gpio
import test_i2c
import test_serial
from guest_devices import PATIENCE_S, program, wait_until, write_file
from harness.cosmos_command import LOOSE, CosmosCommand

chip, bus, cable, adapter = test_i2c.bus, test_can.bus, test_gpio.cable, test_serial.adapter
ALL = ("chip", "bus", "lines", "line")
SCENARIO = """
name: real
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {duration_s: 8}
parameters: {service: reliable, send_device: NAMED}
hardware:
  armed: true
  use:
    - {devices: [USED], agents: [agent-01]}
"""
LOOSE_DEVICES = ("hardware.stale_ratio=1", "hardware.lost=1000", "hardware.on_device_loss=continue")
"""An emulated processor keeps a device waiting now and then."""


@pytest.fixture
def cosmos(chip, bus, cable, tmp_path):
    devices = [
        {"name": "chip", "kind": "i2c", "rate_hz": 10, "serial": "0x33", "outputs": True,
         "parameters": {"bus": chip, "address": test_i2c.CHIP, "map": test_i2c.MAP}},
        {"name": "bus", "kind": "can", "outputs": True,
         "parameters": {"interface": test_can.BUS, "safe_frames_hex": ["123#00FF"]}},
        {"name": "lines", "kind": "gpio", "rate_hz": 10, "outputs": True,
         "parameters": {"chip": test_gpio.LABEL, "lines": test_gpio.LINES}},
        {"name": "line", "kind": "serial", "rate_hz": 1, "outputs": True,
         "parameters": {"port": test_serial.ADAPTER, "safe_frame_hex": b"stop".hex()}},
    ]  # fmt: skip
    machine = {"ansible_connection": "local", "cosmos_devices": devices}
    (tmp_path / "here.yaml").write_text(json.dumps({"all": {"hosts": {"here": machine}}}))
    for name, used in (("all", ALL), ("line", ("line",))):
        text = SCENARIO.replace("NAMED", used[0]).replace("USED", ", ".join(used))
        (tmp_path / f"{name}.yaml").write_text(text)
    with (
        program(test_can.FEEDER, test_can.BUS),
        program(test_serial.FEEDER, test_serial.ITS_END),
    ):
        yield CosmosCommand(tmp_path)


def options(cosmos: CosmosCommand) -> tuple[object, ...]:
    return ("--no-report", "-i", cosmos.folder / "here.yaml")


def records(folder: Path, device: str, stream: str) -> list[str]:
    return (folder / "devices" / "here" / device / f"{stream}.jsonl").read_text().splitlines()


def test_devices_of_four_kinds_are_read_recorded_and_made_safe(cosmos, chip, cable):
    code, document = cosmos.run(
        cosmos.folder / "all.yaml", *LOOSE, *LOOSE_DEVICES, options=options(cosmos)
    )

    # An emulated computer on a busy one loses counting packets now and then, which is no device's.
    broken = {check["name"] for check in document["checks"] if not check["passed"]}
    assert (code, broken) in ((0, set()), (4, {"counter.lost"})), document["verdict"]
    told = document["devices"]
    assert set(told) == {f"here/{name}" for name in ALL}
    folder = cosmos.directory(document)
    for name in ALL:
        assert told[f"here/{name}"]["samples"] > 10, told
        assert '"made_safe"' in "".join(records(folder, name, "events"))
    assert test_i2c.register(chip, test_i2c.VALVE) == 25
    assert cable.lines() & 1 << test_gpio.HEATER
    assert len((folder / "host" / "device_samples.jsonl").read_text().splitlines()) > 10
    assert (folder / "tables" / "device_bus.received.parquet").exists()


def test_an_adapter_that_is_pulled_out_ends_the_run_by_its_name(cosmos):
    adapter = test_serial.usb_device()
    settings = (*LOOSE, "time.duration_s=120", "hardware.stale_ratio=1")
    with cosmos.start_run(
        cosmos.folder / "line.yaml", *settings, options=options(cosmos)
    ) as process:
        try:
            stream = "*/devices/here/line/received.jsonl"
            wait_until(
                lambda: (
                    process.poll() is not None
                    or any(s.read_text().count("\n") > 20 for s in cosmos.runs.glob(stream))
                ),
                120.0,
            )
            write_file(adapter / "authorized", "0")
            out, err = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            write_file(adapter / "authorized", "1")
    document = json.loads(out)
    assert process.returncode == 3, (document.get("verdict", document), err)
    assert document["who"] == "here/line"
    assert "ttyUSB0 is gone" in document["verdict"]
