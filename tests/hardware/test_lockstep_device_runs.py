"""Devices in lockstep: judged by the agents' accounts, and the same records each time."""

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

SCENARIO = """
name: even
simulation: counter
agents: {count: 2, tick_hz: 20}
time: {duration_s: 3, mode: lockstep}
seed: 5
hardware:
  devices:
    - name: gps
      kind: synthetic
      rate_hz: 20
      parameters: {channels: [{name: value, elements: [{shape: sine, amplitude: 1.0, noise: 0.1}]}]}
"""


def test_two_lockstep_runs_with_devices_record_the_same(tmp_path):
    scenario = tmp_path / "even.yaml"
    scenario.write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)

    (code, first), (_, second) = (cosmos.run(scenario, *LOOSE) for _ in range(2))

    assert code == 0, first["verdict"]
    assert first["records_sha256"] == second["records_sha256"]
    assert first["devices"] == second["devices"]
    assert set(first["devices"]) == {"agent-01/gps", "agent-02/gps"}
    assert first["devices"]["agent-01/gps"]["samples"] == 60
    assert "hardware.lost" in {check["name"] for check in first["checks"]}
    assert list(cosmos.directory(first).glob("devices/agent-01/gps/value.jsonl"))
