"""
Rovers drive to their marks: a whole simulation in one file.

It has the three parts that every simulation has:

  RoverParameters   what a scenario may set under `parameters`
  RoverHost         the truth: where every rover really is. One of it, on the host.
  RoverAgent        the software under test. One a rover, each in its own process or on its own board.

The two halves never call each other. They only exchange messages, as a real vehicle and the real
world would: the host tells a rover what its sensor measures, and the rover commands its motor.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Annotated, Any

from annotated_types import Ge, Gt

from madns_runtime.plugin.api import (
    HOST,
    AgentSimulation,
    Check,
    DeclaredStream,
    HostSimulation,
    Simulation,
    Tick,
)
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field


@dataclass(frozen=True, slots=True, kw_only=True)
class RoverParameters:
    """
    What a scenario may set. `cosmos validate` checks types and bounds before anything starts.

    The unit stands in the name. Gt(0) means "greater than 0", Ge(0) "0 or greater".
    """

    distance_m: Annotated[float, Gt(0)] = 5.0
    """From the start to the mark of the first rover; each next rover has one metre more."""
    speed_max_m_s: Annotated[float, Gt(0)] = 2.0
    """A motor turns no faster."""
    noise_m: Annotated[float, Ge(0)] = 0.01
    """Standard deviation of the position sensor."""
    error_max_m: Annotated[float, Gt(0)] = 0.1
    """How far from its mark a rover may stand in the end."""


# --------------------------------------------------------------------------------------------------
# All that is recorded: each stream's fields, with their units. A run remarks on what it records beside this.

TRUTH = (Field("t_s", "s"), Field("agent", "", "str"), Field("position_m", "m"))
DRIVE = (Field("tick", "", "int"), Field("measured_m", "m"), Field("speed_m_s", "m/s"))


def declared_streams(parameters: RoverParameters, agents: tuple[str, ...]) -> list[DeclaredStream]:
    """Return every stream that either half opens."""
    return [
        DeclaredStream(role="host", name="truth", fields=TRUTH),
        DeclaredStream(role="agent", name="drive", fields=DRIVE),
    ]


# --------------------------------------------------------------------------------------------------
# The host's half. It must never keep its caller waiting: a call may take a millisecond. Hand longer
# work to `context.submit(function, *arguments)`; its value comes back through `result`.

TRUTH_STEP_S = 0.02


class RoverHost(HostSimulation):
    """Moves every rover at the speed that it commanded last, and measures where it is."""

    def setup(self, context: Any) -> None:
        # context.agents are the names of all agents, in order.
        self.context = context
        self.t_s = 0.0
        self.position_m = dict.fromkeys(context.agents, 0.0)
        self.speed_m_s = dict.fromkeys(context.agents, 0.0)
        self.refused = dict.fromkeys(context.agents, 0)
        first_m = context.parameters.distance_m
        self.mark_m = {name: first_m + index for index, name in enumerate(context.agents)}
        # One stream is one file of records: host/truth.jsonl in the run's directory.
        context.open_stream("truth", TRUTH)

    def initial_data(self, agent: str) -> dict[str, Any]:
        # What one agent is told before the run starts: the argument `initial` of its setup.
        return {"mark_m": self.mark_m[agent]}

    def timer(self, t_s: float) -> float:
        # Called when the run starts, and then for the simulated time that was returned last.
        step_s = max(0.0, t_s - self.t_s)
        self.t_s = t_s
        for name in self.position_m:
            self.position_m[name] += self.speed_m_s[name] * step_s
            self.context.record("truth", (t_s, name, self.position_m[name]))
            noise_m = self.context.random.normal(0.0, self.context.parameters.noise_m)
            # BEST: only the newest measurement matters, so a lost one is not sent again.
            measurement = {"position_m": self.position_m[name] + noise_m}
            self.context.send(name, measurement, Service.BEST)
        return t_s + TRUTH_STEP_S

    def receive(self, agent: str, message: Any) -> None:
        # A command of an agent. The world has limits, whatever the software asks for.
        wanted_m_s = message["speed_m_s"]
        if not math.isfinite(wanted_m_s):
            # Every comparison with NaN is false: min and max would let it pass as full speed.
            self.refused[agent] += 1
            return
        limit_m_s = self.context.parameters.speed_max_m_s
        self.speed_m_s[agent] = max(-limit_m_s, min(limit_m_s, wanted_m_s))

    def finish(self) -> dict[str, Any]:
        # The run's summary. Every line under "checks" is judged: one that has not passed makes
        # `cosmos run` end with exit code 4.
        limit_m = self.context.parameters.error_max_m
        worst = max(self.refused, key=lambda name: self.refused[name])
        refused = sum(self.refused.values())
        # worst names the agent whose value it is; without it, it is the host's.
        checks = [
            Check(name="commands_refused", limit=0, got=refused, passed=refused == 0, worst=worst)
        ]
        for name, position_m in self.position_m.items():
            error_m = abs(position_m - self.mark_m[name])
            passed = error_m <= limit_m
            checks.append(
                Check(name=f"{name}.error_m", limit=limit_m, got=error_m, passed=passed, worst=name)
            )
        return {"checks": [asdict(check) for check in checks]}


# --------------------------------------------------------------------------------------------------
# The agent's half: the software under test. Change this one first.

GAIN_1_S = 1.5


class RoverAgent(AgentSimulation):
    """Drives towards its mark, the slower the nearer it is."""

    def setup(self, context: Any, initial: dict[str, Any]) -> None:
        # context.name is this agent's name.
        self.context = context
        self.mark_m = initial["mark_m"]
        self.measured_m: float | None = None
        context.open_stream("drive", DRIVE)

    def receive(self, message: Any) -> None:
        # Called between ticks. Keep it short: remember what came, and act on it in step.
        self.measured_m = message["position_m"]

    def step(self, tick: Tick) -> None:
        # Called every tick, at the scenario's tick_hz. tick.t_s is the simulated time; a step that
        # takes longer than the period costs the next ticks, and the run's verdict says so.
        if self.measured_m is None:
            return  # no measurement has come yet
        speed_m_s = GAIN_1_S * (self.mark_m - self.measured_m)
        self.context.record("drive", (tick.index, self.measured_m, speed_m_s))
        # RELIABLE: every command arrives once, and in order.
        self.context.send(HOST, {"speed_m_s": speed_m_s}, Service.RELIABLE)

    def finish(self) -> dict[str, Any]:
        # This agent's part of the run's summary.
        return {"mark_m": self.mark_m, "measured_m": self.measured_m}


# --------------------------------------------------------------------------------------------------
# The descriptor: the scenario's `simulation: ./@NAME@.py:simulation` names it. ":RoverHost" means
# the class RoverHost of this file.

simulation = Simulation(
    name="@NAME@",
    parameters=RoverParameters,
    host=":RoverHost",
    agent=":RoverAgent",
    streams=":declared_streams",
    # What the view of a run shows of every agent while it goes on.
    columns=("drive.measured_m", "drive.speed_m_s"),
)
