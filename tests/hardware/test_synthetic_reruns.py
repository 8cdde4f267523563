"""Devices of a run in lockstep, flown again: all that their agent could find is compared, whatever order channels have."""

import json

import pytest
from harness.cosmos_command import CosmosCommand

pytestmark = pytest.mark.process

SCENARIO = """
name: again
simulation: counter
agents: {count: 1, tick_hz: 1}
time: {mode: lockstep, duration_s: 1.05}
parameters: {send_device: imu}
hardware:
  stale_ratio: 1
  devices:
    - name: imu
      kind: synthetic
      rate_hz: 3
      parameters: {channels: [{name: b, elements: [{offset: 1}]}, {name: a, elements: [{offset: 2}]}]}
"""


def test_samples_up_to_the_last_tick_are_compared_and_those_behind_it_are_counted(tmp_path):
    (tmp_path / "again.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)
    _, document = cosmos.run(tmp_path / "again.yaml")

    done = cosmos("rerun", document["run"], "--json", "--quiet")
    told = json.loads(done.stdout)

    counts = {d["name"]: (d["records"], d["compared"], d["left_out"]) for d in told["devices"]}
    assert counts == {"agent-01/imu.a": (4, 4, 0), "agent-01/imu.b": (4, 4, 0)}
    assert (done.returncode, told["same"]) == (0, True), done.stderr


def test_samples_behind_the_last_tick_are_counted_as_not_seen(tmp_path):
    clear = "{at_s: 1.7, action: device_fault, agents: [agent-01], device: imu, fault: clear}"
    (tmp_path / "again.yaml").write_text(f"{SCENARIO}timeline: [{clear}]\n")
    cosmos = CosmosCommand(tmp_path)
    _, document = cosmos.run(tmp_path / "again.yaml", "time.duration_s=2")

    done = cosmos("rerun", document["run"], "--json", "--quiet")
    told = json.loads(done.stdout)

    counts = {d["name"]: (d["records"], d["compared"], d["left_out"]) for d in told["devices"]}
    assert counts == {"agent-01/imu.a": (6, 4, 2), "agent-01/imu.b": (6, 4, 2)}
    assert (done.returncode, told["same"]) == (0, True), done.stderr


def test_the_records_of_all_processes_that_a_device_had_are_played_and_compared(tmp_path):
    (tmp_path / "again.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)
    _, document = cosmos.run(tmp_path / "again.yaml")
    folder = cosmos.directory(document) / "devices" / "agent-01" / "imu"
    for name in ("a", "b", "device_state"):
        head, *lines = (folder / f"{name}.jsonl").read_text().splitlines(keepends=True)
        (folder / f"{name}.jsonl").write_text("".join([head, *lines[:2]]))
        (folder / f"{name}.2.jsonl").write_text("".join([head, *lines[2:]]))

    done = cosmos("rerun", document["run"], "--json", "--quiet")
    told = json.loads(done.stdout)

    counts = {d["name"]: (d["records"], d["compared"], d["different"]) for d in told["devices"]}
    assert counts == {"agent-01/imu.a": (4, 4, 0), "agent-01/imu.b": (4, 4, 0)}
    assert [each for each in told["remarks"] if each.startswith("agent-01/imu:")] == [
        "agent-01/imu: its process was started anew, 1 time: what an earlier one had not written when it ended is"
        " in no rerun"
    ]


SLOW = """
from madns_runtime.hardware.contract import Channel, DeviceKind, Sample, SimulatedDevice


class Thermometer(SimulatedDevice):
    kind = DeviceKind(
        name="thermometer",
        summary="is read often, and has something new once per second",
        needs_hardware=False,
        can_block=False,
        follows_simulated_time=True,
        rate_hz=2000.0,
        rate_hz_max=5000.0,
        channels=(Channel(name="heat", unit="degC", rate_hz_max=1.0),),
    )

    def sample_at(self, t_s):
        return Sample(values={"heat": t_s}, taken_s=t_s) if t_s == round(t_s) else None
"""


def test_a_device_that_gives_less_than_it_is_read_is_as_fresh_as_it_was(tmp_path):
    (tmp_path / "heat.py").write_text(SLOW)
    scenario = SCENARIO[: SCENARIO.index("hardware:")].replace(": imu", ": heat")
    device = "hardware: {devices: [{name: heat, kind: ./heat.py:Thermometer}]}\n"
    (tmp_path / "again.yaml").write_text(scenario + device)
    cosmos = CosmosCommand(tmp_path)
    _, document = cosmos.run(tmp_path / "again.yaml", "agents.tick_hz=20", "time.duration_s=3")

    done = cosmos("rerun", document["run"], "--json", "--quiet")
    told = json.loads(done.stdout)

    assert (done.returncode, told["same"]) == (0, True), done.stderr
    rerun = json.loads((cosmos.directory(document).parent / told["rerun"] / "run.json").read_text())
    ratios = [run["devices"]["agent-01/heat"]["stale_ratio"] for run in (document, rerun)]
    assert ratios == [0.0, 0.0]
