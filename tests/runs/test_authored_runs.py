"""A scenario that extends another, from a root above it, with parameters of one agent's own: flown, kept, flown again."""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

PLUGIN = """
from dataclasses import dataclass
from pathlib import Path
from madns_runtime.plugin.api import AgentSimulation, Field, HostSimulation, Simulation

@dataclass(frozen=True, kw_only=True)
class Parameters:
    gain: float = 1.0
    table: str = "data/table.txt"
    is_recorded: bool = True

class Host(HostSimulation):
    def setup(self, context):
        self.context = context

    def finish(self):
        agents = self.context.agent_parameters
        return {"gain": self.context.parameters.gain, "gains": {name: own.gain for name, own in agents.items()}}

class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.gain = context.parameters.gain
        self.table = (context.base_directory / context.parameters.table).read_text().strip()
        self.context = context
        if context.parameters.is_recorded:
            context.open_stream("heights", [Field("t_s", "s"), Field("height_m", "m")])

    def step(self, tick):
        if self.context.parameters.is_recorded:
            self.context.record("heights", [tick.t_s, self.gain * tick.t_s])

    def finish(self):
        return {"gain": self.gain, "table": self.table}

simulation = Simulation(name="gains", parameters=Parameters, host=":Host", agent=":Agent")
"""
BASE = """\
name: base
simulation: ./code/gains.py:simulation
agents: {count: 3, tick_hz: 10}
time: {mode: lockstep, duration_s: 1}
vars: {gain: 2}
parameters: {gain: "${gain}"}
"""
SCENARIO = """\
extends: ../base.yaml
root: ..
name: few
agent_parameters:
  - {agents: [agent-02], parameters: {gain: 7}}
"""


@pytest.fixture(scope="module")
def cosmos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("authored")
    for name, text in {
        "tree/code/gains.py": PLUGIN,
        "tree/data/table.txt": "first\n",
        "tree/base.yaml": BASE,
        "tree/few/few.yaml": SCENARIO,
    }.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return CosmosCommand(folder)


@pytest.fixture(scope="module")
def run(cosmos):
    """A run of it in lockstep."""
    code, document = cosmos.run(cosmos.folder / "tree/few/few.yaml", "vars.gain=3")
    assert code == 0
    return document


@pytest.mark.process
def test_each_agent_has_its_own_parameters_and_the_host_all(run):
    assert run["simulation"]["host"]["gain"] == 3
    gains = {"agent-01": 3, "agent-02": 7, "agent-03": 3}
    assert run["simulation"]["host"]["gains"] == gains
    assert {name: own["gain"] for name, own in run["simulation"]["agents"].items()} == gains


@pytest.mark.process
def test_a_run_keeps_what_results_and_all_of_its_root(cosmos, run):
    kept = cosmos.runs / run["run"]
    text = (kept / "scenario.yaml").read_text()
    names = {path.relative_to(kept / "flown").as_posix() for path in (kept / "flown").rglob("*.*")}

    assert "base.yaml\n#   --set vars.gain=3\n" in text
    assert "gain: 3" in text
    assert "vars:" not in text
    assert names == {"base.yaml", "code/gains.py", "data/table.txt", "few/few.yaml"}


@pytest.mark.process
def test_such_a_run_is_flown_again_as_it_was(cosmos, run):
    (cosmos.folder / "tree/data/table.txt").write_text("second\n")

    done = cosmos("rerun", run["run"], "--as-recorded", "--json", "--quiet")

    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.process
def test_a_run_without_records_is_not_told_as_the_same(cosmos):
    code, run = cosmos.run(cosmos.folder / "tree/few/few.yaml", "parameters.is_recorded=false")
    assert code == 0

    done = cosmos("rerun", run["run"], "--json", "--quiet")

    assert done.returncode == 1, done.stdout + done.stderr
    assert json.loads(done.stdout)["remarks"] == ["neither run has a record that is judged"]


@pytest.mark.process
def test_in_real_time_agents_have_their_own_parameters_too(cosmos):
    few = cosmos.folder / "tree/few/few.yaml"

    _, run = cosmos.run(few, "time.mode=realtime", *LOOSE)

    assert {name: own["gain"] for name, own in run["simulation"]["agents"].items()} == {
        "agent-01": 2,
        "agent-02": 7,
        "agent-03": 2,
    }
