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
