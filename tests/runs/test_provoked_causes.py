"""
Late ticks with a cause that was brought about on purpose: it is named.

On a busy machine the scheduler may be the cause of more of them.
"""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.nights import by_night

pytestmark = pytest.mark.process

HALVES = """
import time
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    pass


class Host(HostSimulation):
    def setup(self, context):
        self.context = context

    def receive(self, agent, message):
        self.context.send(agent, message)


class Busy(AgentSimulation):
    def setup(self, context, initial):
        self.context = context

    def compute(self, seconds):
        end_s = time.thread_time() + seconds
        while time.thread_time() < end_s:
            pass


class Stepping(Busy):
    def step(self, tick):
        if tick.index % 10 == 5:
            self.compute(0.25)


class Receiving(Busy):
    def step(self, tick):
        if tick.index % 10 == 5:
            self.context.send("host", [tick.index])

    def receive(self, message):
        self.compute(0.25)


class Neighbour(Busy):
    def step(self, tick):
        if self.context.name == "agent-01" and tick.index % 10 == 5:
            self.compute(0.06)




simulation = Simulation(name="own", parameters=Parameters, host=":Host", agent=":{agent}")
"""


def causes(tmp_path, agent, *settings):
    (tmp_path / "own.py").write_text(HALVES.replace("{agent}", agent))
    (tmp_path / "own.yaml").write_text(
        "name: own\nsimulation: ./own.py:simulation\nagents: {count: 2, tick_hz: 20}\n"
        "time: {duration_s: 4}\ndeadline: {overrun_ms: 20, max_miss_ratio: 1}\n"
    )
    cosmos = CosmosCommand(tmp_path)
    code, document = cosmos.run(tmp_path / "own.yaml", *LOOSE, "deadline.overrun_ms=20", *settings)
    assert code == 0, document["verdict"]
    timing = document["timing"]
    assert sum(timing["causes"].values()) == timing["missed"] + timing["late"]
    assert json.dumps(document["remarks"]).count("missed") >= 1
    return document


@pytest.mark.parametrize(
    ("agent", "cause"),
    by_night([("Stepping", "step"), ("Receiving", "receiving")], day=[("Stepping", "step")]),
)
def test_own_work_that_takes_too_long_is_named(tmp_path, agent, cause):
    document = causes(tmp_path, agent)

    counts = document["timing"]["causes"]
    assert {cause, "wake_up"} & set(counts)
    most = [name for name, count in counts.items() if count == max(counts.values())]
    assert any(f"by {name} (" in json.dumps(document["remarks"]) for name in most)
    assert set(document["timing"]["causes_by_agent"]) == {"agent-01", "agent-02"}


def test_a_neighbour_in_the_process_is_named(tmp_path):
    document = causes(tmp_path, "Neighbour", "agents.per_process=2", "deadline.lateness_ms=20")

    # Where others compete for the processor, the scheduler has the greater part in it: test_loop_account has both apart.
    assert {"other_agent", "wake_up"} & set(document["timing"]["causes_by_agent"]["agent-02"])
