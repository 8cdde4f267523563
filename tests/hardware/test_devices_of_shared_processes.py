"""Devices of agents that share a process, and of which one ends while the others go on."""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

from madns_runtime.recording.reader import read_stream

pytestmark = pytest.mark.process

MOVER = """
from dataclasses import dataclass

from madns_runtime.plugin.api import AgentSimulation, Simulation


@dataclass(frozen=True, kw_only=True)
class Parameters:
    pass


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context, self.ticks = context, 0

    def step(self, tick):
        self.ticks += 1
        if self.ticks == 2:
            valve = self.context.hardware["valve"]
            valve.write("duty", 5.0)
            valve.write("duty", 9.0, due_s=4.0)
            valve.play("coil", [(4.0 + k / 10, 1.0 + k) for k in range(5)])
        if self.context.name == "agent-02" and tick.t_s >= 1.0:
            raise ValueError("out of order")


simulation = Simulation(name="mover", parameters=Parameters, agent=":Agent")
"""
SCENARIO = """
name: shared
simulation: ./mover.py:simulation
agents: {count: 4, tick_hz: 10, per_process: 4}
time: {duration_s: 6}
on_agent_loss: continue
hardware:
  armed: true
  devices: [{name: valve, kind: "null", rate_hz: 10, parameters: {outputs: [duty, coil]}}]
timeline:
  - {at_s: 1, action: kill, agents: [agent-01]}
  - {at_s: 1, action: restart, agents: [agent-03]}
"""


def rows(path):
    return list(map(json.loads, path.read_text().splitlines()[1:]))


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """Return such a run, and the folder of its devices."""
    folder = tmp_path_factory.mktemp("shared")
    (folder / "mover.py").write_text(MOVER)
    (folder / "shared.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(folder)
    _, document = cosmos.run(folder / "shared.yaml", *LOOSE)
    return document, cosmos.directory(document)


def made_safe_s(folder, agent):
    events = rows(folder / f"devices/{agent}/valve/events.jsonl")
    return [event["t_s"] for event in events if event.get("event") == "made_safe"]


def put_out(folder, agent, channel):
    return [
        row[-1] for row in read_stream(folder / f"devices/{agent}/valve/{channel}.jsonl").records()
    ]


@pytest.mark.parametrize("agent", ["agent-01", "agent-02"])
def test_what_an_agent_moved_is_made_safe_at_once_though_others_keep_its_process(shared, agent):
    document, folder = shared

    assert 1.0 <= made_safe_s(folder, agent)[0] < 2.5  # 0.5 s, and what a busy machine adds to it
    assert put_out(folder, agent, "duty") == [5.0]
    assert put_out(folder, agent, "coil") == []
    device = document["devices"][f"{agent}/valve"]
    assert device["counts"]["writes_lost"] == 1
    assert device["stimulus"]["coil"]["unplayed"] == 5
    assert device["unsafe"] == 0


def test_an_agent_that_returns_to_its_process_moves_its_device_again(shared):
    document, folder = shared

    assert 1.0 <= made_safe_s(folder, "agent-03")[0] < 2.5
    assert put_out(folder, "agent-03", "duty") == [5.0, 5.0, 9.0]
    told = document["devices"]["agent-03/valve"]["stimulus"]["coil"]
    assert (told["points"], told["unplayed"]) == (10, 5)
    assert told["played"] + told["skipped"] == 5
    assert document["devices"]["agent-03/valve"]["restarts"] == 0


def test_an_agent_that_returns_to_its_process_is_told_its_devices_status(shared):
    _, folder = shared

    for name in ("events", "events.2"):
        events = rows(folder / f"agents/agent-03/{name}.jsonl")
        told = [event["status"] for event in events if event.get("event") == "device"]
        assert told[:1] == ["ok"]


def test_outputs_of_an_agent_that_goes_on_are_left_alone(shared):
    document, folder = shared

    assert made_safe_s(folder, "agent-04")[0] > 5.0
    assert put_out(folder, "agent-04", "duty") == [5.0, 9.0]
    assert document["devices"]["agent-04/valve"]["stimulus"]["coil"]["unplayed"] == 0
