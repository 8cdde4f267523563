"""A run in lockstep that lost an agent by itself, and went on, is flown again with that loss."""

import json

import pytest
from harness.cosmos_command import CosmosCommand

PLUGIN = """
from dataclasses import dataclass

from madns_runtime.plugin.api import AgentSimulation, Simulation
from madns_runtime.recording.records import Field


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    breaks_s: float = 1.0


class Walker(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        context.open_stream("steps", (Field("t_s", "s"), Field("step_m", "m")))

    def step(self, tick):
        self.context.record("steps", (tick.t_s, float(self.context.random.normal())))
        if self.context.name == "agent-02" and tick.t_s == self.context.parameters.breaks_s:
            raise ValueError("a leg")


simulation = Simulation(name="walkers", parameters=Parameters, agent=":Walker")
"""
SCENARIO = """
name: walkers
simulation: ./walkers.py:simulation
agents: {count: 3, tick_hz: 10, restarts_max: RESTARTS}
on_agent_loss: continue
time: {mode: lockstep, duration_s: 2}
"""


@pytest.mark.process
@pytest.mark.parametrize("restarts", [0, 1])
def test_a_loss_in_lockstep_is_flown_again(tmp_path, restarts):
    (tmp_path / "walkers.py").write_text(PLUGIN)
    (tmp_path / "walkers.yaml").write_text(SCENARIO.replace("RESTARTS", str(restarts)))
    cosmos = CosmosCommand(tmp_path)
    code, _ = cosmos.run(tmp_path / "walkers.yaml")

    done = cosmos("rerun", "last", "--json", "--quiet")

    assert code == 4  # the loss is judged
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["same"] and told["remarks"] == []
