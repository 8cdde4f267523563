"""A host and agents that say something each second, and write to their standard error."""

import sys
from dataclasses import dataclass

from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation


@dataclass(frozen=True)
class Parameters:
    pass


class Host(HostSimulation):
    def setup(self, context):
        self.context = context

    def initial_data(self, agent):
        return {}

    def start(self, t_s):
        self.context.log("warning", "the host begins")

    def receive(self, agent, message):
        pass

    def timer(self, t_s):
        return None

    def result(self, job, value):
        pass

    def finish(self):
        return {}


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        self.said_at = []

    def step(self, tick):
        # A busy machine may miss the tick that is meant: then it is said in the next, as of that one.
        due = tick.index - tick.index % 10
        if due not in self.said_at:
            self.said_at.append(due)
            self.context.log("warning", f"tick {due}\nof \x1b[31mmany")
            self.context.log("error", f"wrong {due}")
        if tick.index >= 5 and 5 not in self.said_at:
            self.said_at.append(5)
            sys.stderr.write("a word on stderr\n")
            sys.stderr.flush()

    def receive(self, message):
        pass

    def finish(self):
        return {}


simulation = Simulation(name="talk", parameters=Parameters, host=":Host", agent=":Agent")
