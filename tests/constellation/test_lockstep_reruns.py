"""A run in lockstep is the same again though its flight software was started anew and its messages came late."""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

FLIGHT = """
from madns_runtime.simulations.constellation.flight.api import FlightSoftware


class Burn(FlightSoftware):
    def setup(self, context):
        self.context, self.told = context, 0

    def step(self, t_s, readings):
        if round(2 * t_s) % 6 == 0:
            self.context.delta_v((0, 0.01, 0), at_s=t_s + 3.0)
        self.context.estimate({"told": float(self.told)})

    def command_result(self, result):
        self.told += 1
"""
BURNS = """
name: burns
simulation: constellation
agents: {count: 2, tick_hz: 2}
time: {mode: lockstep, duration_s: 30}
on_agent_loss: continue
parameters:
  satellites: {walker: "56:2/1/0", altitude_km: 780}
  epoch_utc: 2026-01-01T00:00:00Z
  vehicles: [{thruster: {isp_s: 220, propellant_kg: 5}}]
  flight: burn.py:Burn
timeline:
  - {at_s: 10, action: restart, agents: [agent-01]}
  - {at_s: 14, action: delay_messages, agents: [agent-02], traffic: with_host, delay_s: 1.2, jitter_s: 2, for_s: 10}
"""


@pytest.mark.process
def test_a_lockstep_run_with_a_restart_and_late_results_is_the_same_again(tmp_path):
    (tmp_path / "burn.py").write_text(FLIGHT)
    (tmp_path / "burns.yaml").write_text(BURNS)
    cosmos = CosmosCommand(tmp_path)
    cosmos.run(tmp_path / "burns.yaml", *LOOSE)

    done = cosmos("rerun", "last", "--json", "--quiet")

    told = json.loads(done.stdout)
    assert done.returncode == 0 and told["same"], told["diff"]
