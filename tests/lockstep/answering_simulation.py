"""A simulation whose agents answer what they receive, beside what they send in their steps."""

from dataclasses import dataclass

from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation
from madns_runtime.recording.records import Field


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    fault: str = ""
    """None is known here."""


class Host(HostSimulation):
    def setup(self, context):
        self.context = context
        context.open_stream(
            "heard", (Field("t_s", "s"), Field("who", "", "str"), Field("what", "", "str"))
        )

    def receive(self, agent, message):
        self.context.record("heard", (self.context.now_s(), agent, message))
        if message == "step":
            self.context.send(agent, "question")


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context

    def receive(self, message):
        self.context.send(HOST, "answer")

    def step(self, tick):
        self.context.send(HOST, "step")


simulation = Simulation(name="answering", parameters=Parameters, host=":Host", agent=":Agent")
