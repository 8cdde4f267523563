"""A simulation whose agents tell what they hear and may send, in set-up and on what the host's half sends them."""

from dataclasses import dataclass

from madns_runtime.errors import PluginError
from madns_runtime.medium.links import LinkMedium
from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field


class ReturningHost(HostSimulation):
    """Greets every agent as it is given its initial data, and answers what it is asked."""

    def setup(self, context):
        self.context = context

    def initial_data(self, agent):
        self.context.send(agent, "welcome")
        return {}

    def receive(self, agent, message):
        if message == "ask":
            self.context.send(agent, "answer")


class ReturningAgent(AgentSimulation):
    """Passes an answer of the host on to all agents, and counts."""

    def setup(self, context, initial):
        self.context = context
        self.told = []
        context.open_stream("marks", (Field("mark"),))
        context.record("marks", (1.0,))
        try:
            context.send(HOST, "early", Service.SYNC, deadline_s=context.now_s() + 5.0)
        except PluginError as error:
            self.told.append(str(error))

    def receive(self, message):
        self.told.append(message)
        if message == "answer":
            self.context.send("*", "passed on")

    def step(self, tick):
        self.t_s = tick.t_s
        if tick.index == 3 and self.context.name == "agent-01":
            self.context.send(HOST, "ask")

    def hear(self, delivery):
        self.told.append([delivery.payload, delivery.sent_s, round(self.t_s + 0.1, 6)])

    def finish(self):
        return {"told": self.told, "counts": self.context.message_counts()}


def medium(host, context):
    """Return a medium in which everybody hears everybody after 5 ms."""
    del host
    return LinkMedium(context.agents, context.random, delay_s=0.005)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """None."""


simulation = Simulation(
    name="returning",
    parameters=Parameters,
    host=":ReturningHost",
    agent=":ReturningAgent",
    medium=":medium",
)
"""For runs of 10 Hz."""
