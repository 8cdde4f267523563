"""A simulation that counts what arrives: each side sends numbers in every class of service, agents also to each other."""

from collections import Counter
from dataclasses import dataclass

from madns_runtime.medium.links import LinkMedium
from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field

PERIOD_S = 0.1
SERVICES = (Service.BEST, Service.RELIABLE, Service.SYNC)
HEARD = (Field("t_s", "s"), Field("who", "", "str"), Field("what", "", "json"))


class FaultHost(HostSimulation):
    """Sends every agent one message per period, and records what it hears."""

    def setup(self, context):
        self.context = context
        self.number = 0
        self.away = set()
        self.heard = Counter()
        context.open_stream("heard", HEARD)

    def receive(self, agent, message):
        self.heard[agent] += 1
        self.context.record("heard", (self.context.now_s(), agent, message))

    def timer(self, t_s):
        for agent in self.context.agents:
            if t_s >= 0.0 and agent not in self.away:
                self.context.send(agent, ["down", self.number], SERVICES[self.number % 3])
        self.number += 1
        return t_s + PERIOD_S

    def agent_lost(self, agent, reason):
        self.away.add(agent)
        self.context.record("heard", (self.context.now_s(), agent, ["lost", reason]))

    def agent_rejoined(self, agent):
        self.away.discard(agent)
        self.context.record("heard", (self.context.now_s(), agent, ["rejoined"]))

    def finish(self):
        return {"heard": dict(self.heard)}


class FaultAgent(AgentSimulation):
    """Sends one message per tick to the host, and one to all agents, and records what it hears."""

    def setup(self, context, initial):
        self.context = context
        self.heard = Counter()
        context.open_stream("heard", HEARD)
        context.open_stream("steps", (Field("t_s", "s"), Field("tick", "", "int")))

    def step(self, tick):
        if tick.index >= 20 and self.context.name == self.context.parameters.dies:
            raise ValueError("told to")
        self.context.record("steps", (tick.t_s, tick.index))
        self.context.send(HOST, ["up", tick.index], SERVICES[tick.index % 3])
        self.context.send("*", ["between", tick.index])

    def receive(self, message):
        self.heard[HOST] += 1
        self.context.record("heard", (self.context.now_s(), HOST, message))

    def hear(self, delivery):
        self.heard[delivery.sender] += 1
        self.context.record("heard", (delivery.arrives_s, delivery.sender, delivery.payload))

    def finish(self):
        return {"heard": dict(self.heard)}


def medium(host, context):
    """Return a medium in which everybody hears everybody after 50 ms."""
    del host
    return LinkMedium(context.agents, context.random, delay_s=0.05)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """Settings."""

    dies: str = ""
    """An agent that raises in its twentieth tick, or in the next that it has not missed."""


simulation = Simulation(
    name="faults",
    parameters=Parameters,
    host=":FaultHost",
    agent=":FaultAgent",
    medium=":medium",
)
