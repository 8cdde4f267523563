"""What a simulation of one's own finds wrong with a timeline's entries of its own actions, before a run."""

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario

pytestmark = pytest.mark.process

PLUGIN = """\
from dataclasses import dataclass
from madns_runtime.plugin.api import ActionKind, AgentSimulation, Simulation
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    doors: tuple[str, ...] = ("left", "right")
@dataclass(frozen=True, slots=True, kw_only=True)
class Jam:
    door: str
class Agent(AgentSimulation):
    def begin_action(self, action): pass
JAM = ActionKind(word="jam", summary="Jams a door.", parameters=Jam, carried_out_by="agent")
simulation = Simulation(
    name="doors", parameters=Parameters, agent=":Agent", actions=(JAM,), check_actions=":check_actions"
)
def check_actions(parameters, actions, agents, base_directory):
    for action in actions:
        if action.parameters.door not in parameters.doors:
            yield f"{action.place}.door: no door {action.parameters.door!r} of {'+'.join(action.agents)}"
"""
SCENARIO = """\
name: doors
simulation: ./doors.py:simulation
agents: {count: 3}
time: {mode: lockstep, duration_s: 9}
timeline:
  - {at_s: 1, action: annotate, text: a}
  - {at_s: 1, action: jam, agents: [agent-01], door: left}
  - {at_s: 2, action: jam, agents: ["agent-0[23]"], door: rear}
"""


def faults(folder, plugin):
    (folder / "doors.py").write_text(plugin)
    path = folder / "doors.yaml"
    path.write_text(SCENARIO)
    with pytest.raises(InputError) as refused:
        load_scenario(path)
    return [(each.line, each.path, each.text) for each in refused.value.faults]


def test_its_words_stand_at_the_entry_and_it_is_given_the_agents_that_are_meant(tmp_path):
    assert faults(tmp_path, PLUGIN) == [
        (8, "timeline[2].door", "no door 'rear' of agent-02+agent-03")
    ]


def test_one_that_returns_no_list_of_texts_is_to_blame(tmp_path):
    ((line, path, text),) = faults(tmp_path, PLUGIN.replace("yield f", "return 1  # "))

    assert (line, path) == (2, "simulation")
    assert "doors.py:15: check_actions() must return a list of texts" in text
