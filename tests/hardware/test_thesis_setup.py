"""The thesis's set-up: boards that count, one of which reads a Sense HAT and sends its samples to the host."""

import json
from statistics import median

import pytest
from harness.cosmos_command import LOOSE, SCENARIOS, CosmosCommand
from harness.sense_emulator import fed_emulator

pytestmark = pytest.mark.process

SCENARIO = SCENARIOS / "thesis" / "hwil_counter.yaml"
EMULATED = "{name: hat, kind: sense_hat, rate_hz: 20, parameters: {emulated: true}}"
STAND_IN = """{name: hat, kind: synthetic, rate_hz: 20, parameters: {channels: [
        {name: gyroscope, unit: rad/s, elements: [{shape: sine}, {}, {offset: 0.5}], components: [x, y, z]},
        {name: temperature, unit: degC, elements: [{offset: 21.5}]}]}}"""


CLOCK_ERROR_US = 20_000
"""What a busy machine, whose messages wait at both ends, may cost the estimate."""
LOOSE_DEVICES = (
    "hardware.stale_ratio=1",
    "hardware.lost=1000",
    "vars.late_ms_max=60000",
    "vars.samples_hz_min=0",
)
"""So that a busy machine, which keeps a device's process waiting, breaks no check."""


def run(tmp_path, device, *settings):
    """Run the scenario on this computer, which bears the names of all boards that it needs."""
    inventory = tmp_path / "here.yaml"
    inventory.write_text(
        "all:\n  vars: {ansible_connection: local, ansible_host: 127.0.0.1}\n  hosts:\n"
        f"    pi22:\n      cosmos_devices:\n      - {device}\n"
    )
    cosmos = CosmosCommand(tmp_path)
    code, document = cosmos.run(
        SCENARIO,
        "time.duration_s=4",
        *LOOSE,
        *LOOSE_DEVICES,
        *settings,
        options=("--no-report", "-i", inventory),
    )
    return code, document, cosmos.directory(document)


def rows(folder):
    """Return the device samples that the host recorded, as mappings."""
    head, *lines = (folder / "host" / "device_samples.jsonl").read_text().splitlines()
    names = [field["name"] for field in json.loads(head)["fields"]]
    return [
        dict(zip(names, line, strict=True))
        for line in map(json.loads, lines)
        if isinstance(line, list)
    ]


@pytest.mark.nightly
def test_samples_of_a_stand_in_reach_the_host_with_their_delay(tmp_path):
    code, document, folder = run(tmp_path, STAND_IN)

    assert code == 0, document["verdict"]
    assert [text for text in document["remarks"] if "declared" in text] == []
    found = rows(folder)
    assert {row["channel"] for row in found} == {"gyroscope", "temperature"}
    assert {row["device"] for row in found} == {"agent-22/hat"}
    assert document["simulation"]["host"]["device_samples"] == {"agent-22": len(found)}
    gyroscope = [row for row in found if row["channel"] == "gyroscope"]
    assert len(gyroscope) > 5
    assert all(row["values"][2] == 0.5 for row in gyroscope)
    delays_us = [row["delay_us"] for row in found if row["t_s"] > 0.5]
    # A sample may be taken just before its tick, and the agent's clock is an estimate.
    assert median(delays_us) > 0 and min(delays_us) > -CLOCK_ERROR_US
    numbers = [row["number"] for row in gyroscope]
    assert numbers == sorted(set(numbers))
    assert (folder / "devices" / "pi22" / "hat" / "gyroscope.jsonl").is_file()


@pytest.mark.nightly
def test_a_device_that_nobody_uses_breaks_a_check(tmp_path):
    code, document, _ = run(tmp_path, STAND_IN, "parameters.send_device=camera", "agents.count=22")

    assert code == 4, document["verdict"]
    assert [c["name"] for c in document["checks"] if c["passed"] is not True] == [
        "counter.device_absent",
        "samples",
    ]
    absent = next(c for c in document["checks"] if c["name"] == "counter.device_absent")
    assert (absent["got"], absent["passed"], absent["worst"]) == (1, False, "camera")


def test_an_emulated_hat_is_read_in_the_thesis_s_set_up(tmp_path):
    with fed_emulator():
        code, document, folder = run(tmp_path, EMULATED, "agents.count=22")

    assert code == 0, document["verdict"]
    newest = {row["channel"]: row["values"] for row in rows(folder)}
    assert {"gyroscope", "accelerometer", "magnetometer"} <= set(newest)
    assert newest["temperature"] == pytest.approx(30.0, abs=0.5)
    assert newest["pressure"] == pytest.approx(1013.0, abs=5.0)
    assert (folder / "devices" / "pi22" / "hat" / "temperature.jsonl").is_file()


def test_the_inventory_has_the_hat_where_the_scenario_wants_it(tmp_path):
    cosmos = CosmosCommand(tmp_path)

    done = cosmos(
        "plan", SCENARIO, "-i", SCENARIO.parents[2] / "inventory" / "thesis" / "hwil.yaml", "--json"
    )

    assert done.returncode == 0, done.stderr
    machines = json.loads(done.stdout)["plan"]["machines"]
    assert machines["pi22"]["agents"] == ["agent-22"]
    assert len(machines) == 24
