"""The text of a simulation whose agents raise where they are to carry out an action."""

ACTING = """
from dataclasses import dataclass
from madns_runtime.plugin.api import ActionKind, AgentSimulation, Simulation
@dataclass(frozen=True)
class Parameters:
    pass
class Agent(AgentSimulation):
    def begin_action(self, action):
        raise ValueError("told to")
simulation = Simulation(
    name="acting", parameters=Parameters, agent=":Agent",
    actions=(ActionKind(word="act", summary="Acts.", carried_out_by="agent"),),
)
"""
