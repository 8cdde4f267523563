"""
A simulation that misbehaves as its parameters say; copied beside a scenario by the tests.

Agents send a number every tick and the host returns it: enough traffic to be in every call.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation, Tick
from madns_runtime.recording.records import Field

INIT_DELAY = "COSMOS_TEST_INIT_S"
"""Agents take this long to be made: before they can say hello."""
STRUCK = "struck"
"""A file beside this one: what is to go wrong has begun to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultParameters:
    """Where and when what goes wrong."""

    side: Literal["host", "agent", "nobody"] = "nobody"
    method: str = ""
    action: Literal["raise", "sleep", "print", "exit"] = "raise"
    sleep_s: float = 0.0
    agent: str = "agent-02"
    """The one agent that misbehaves, if agents do."""
    tick: int = 10
    """From this tick on, the first of its calls does it."""
    waste_bytes: int = 0
    """Recorded by that agent every tick."""
    host_waste_bytes: int = 0
    """Recorded by the host for every message."""


class Fault:
    """What goes wrong in one half."""

    def __init__(self, parameters: FaultParameters, side: str, name: str) -> None:
        is_meant = parameters.side == side and name in (HOST, parameters.agent)
        self.method = parameters.method if is_meant else None
        self.parameters = parameters

    def strike(self, method: str) -> None:
        """Do it, once, if this is the method that is meant."""
        if self.method != method:
            return
        self.method = None
        Path(__file__).with_name(STRUCK).touch()
        action = self.parameters.action
        if action == "raise":
            raise ValueError(f"{method} is broken on purpose")  # the line that messages must name
        if action == "sleep":
            time.sleep(self.parameters.sleep_s)
        elif action == "exit":
            sys.exit(f"{method} leaves")
        else:
            print('{"event": "finished", "result": null}')  # noqa: T201 - what plug-ins do
            print("a plug-in talks", flush=True)  # noqa: T201
            os.write(1, b'{"event":"state","state":"EXIT"}\n')


def divide(number: int) -> int:
    return 100 // number  # the line that messages about a job must name


def sleep_long(number: int) -> None:
    time.sleep(600)


class FaultyHost(HostSimulation):
    def setup(self, context: Any) -> None:
        self.context = context
        self.lost: list[str] = []
        self.fault = Fault(context.parameters, "host", HOST)
        context.open_stream("echoes", (Field("agent", "", "str"), Field("waste", "", "str")))
        self.fault.strike("setup")
        job = sleep_long if self.fault.method == "long job" else divide
        context.submit(job, 0 if self.fault.method == "job" else 7)

    def initial_data(self, agent: str) -> Mapping[str, Any]:
        self.fault.strike("initial_data")
        return {"greeting": agent}

    def start(self, t_s: float) -> None:
        self.fault.strike("start")

    def receive(self, agent: str, message: Any) -> None:
        self.context.record("echoes", (agent, "x" * self.context.parameters.host_waste_bytes))
        self.context.send(agent, message)
        if message >= self.context.parameters.tick:
            self.fault.strike("receive")

    def timer(self, t_s: float) -> float:
        if t_s > 0.2:
            self.fault.strike("timer")
        return t_s + 0.1

    def result(self, job: int, value: Any) -> None:
        self.fault.strike("result")

    def agent_lost(self, agent: str, reason: str) -> None:
        self.lost.append(agent)

    def finish(self) -> Mapping[str, Any]:
        self.fault.strike("finish")
        return {"lost": self.lost}


class FaultyAgent(AgentSimulation):
    def __init__(self) -> None:
        time.sleep(float(os.environ.get(INIT_DELAY, "0")))

    def setup(self, context: Any, initial: Mapping[str, Any]) -> None:
        assert initial == {"greeting": context.name}
        self.context = context
        self.fault = Fault(context.parameters, "agent", context.name)
        is_wasteful = context.name == context.parameters.agent
        self.waste = "x" * (context.parameters.waste_bytes if is_wasteful else 0)
        context.open_stream("waves", (Field("tick", "", "int"), Field("waste", "", "str")))
        self.fault.strike("setup")

    def step(self, tick: Tick) -> None:
        self.context.record("waves", (tick.index, self.waste))
        self.context.send(HOST, tick.index)
        if tick.index >= self.context.parameters.tick:
            self.fault.strike("step")

    def receive(self, message: Any) -> None:
        if message >= self.context.parameters.tick:
            self.fault.strike("receive")

    def finish(self) -> Mapping[str, Any]:
        self.fault.strike("finish")
        return {}


simulation = Simulation(
    name="faulty", parameters=FaultParameters, host=":FaultyHost", agent=":FaultyAgent"
)
