"""
A constellation in one process, for trying control: truth by scipy, radio by a tick's delay, burns as impulses.

Coarse on purpose: a tick is as long as the test says, and commands take effect in the tick that holds
their time. The run proper has host, agents, links and truth buffers between the two.
"""

import importlib.util
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from madns_runtime.simulations.constellation.flight.api import TRUTH, Reading
from madns_runtime.simulations.constellation.messages import Command, CommandResult, Delivery
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.frames import rtn_to_inertial
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import ScipyDop853

SCENARIOS = Path(__file__).parents[2] / "scenarios"
_numbers = itertools.count()


def flight_class(file: str, name: str) -> type:
    """Return a class of a file beside the shipped scenarios."""
    spec = importlib.util.spec_from_file_location(
        f"_flight_{next(_numbers)}", SCENARIOS / "flight" / file
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, name)


@dataclass
class Vehicle:
    """What flight software is given as its context, and what became of its wishes."""

    fleet: "Fleet"
    name: str
    index: int
    agents: tuple[str, ...]
    settings: Mapping
    duration_s: float
    ballistic_range: tuple[float, float] = (0.0, np.inf)
    tick_hz: float = 1.0
    epoch_utc: str = "2020-01-01T00:00:00Z"
    frame: str = "TEME"
    estimates: list = field(default_factory=list)
    commands: list = field(default_factory=list)
    sent: int = 0
    sign: float = 1.0
    """Of what is executed against what is commanded: -1 shows that a test can fail."""

    @property
    def satellite(self):
        return self.name

    @property
    def random(self):
        return np.random.default_rng(self.index)

    def delta_v(self, delta_v_m_s, *, at_s, frame="rtn"):
        return self._command("delta_v", delta_v_m_s, at_s, frame)

    def ballistic(self, ballistic_m2_kg, *, at_s):
        low, high = self.ballistic_range
        assert low <= ballistic_m2_kg <= high
        return self._command("ballistic", (ballistic_m2_kg, 0.0, 0.0), at_s, "inertial")

    def _command(self, kind, vector, at_s, frame):
        assert at_s >= self.fleet.t_s
        command = Command(
            number=len(self.commands), kind=kind, commanded_s=self.fleet.t_s, at_s=at_s,
            frame=frame, vector=tuple(vector),
        )  # fmt: skip
        self.commands.append(command)
        self.fleet.waiting.append((self.index, command))
        return command.number

    def send(self, to, payload):
        self.sent += 1
        self.fleet.air.append((self.index, self.agents.index(to), payload))

    def broadcast(self, payload):
        for other in range(len(self.agents)):
            if other != self.index:
                self.fleet.air.append((self.index, other, payload))
        self.sent += 1

    def estimate(self, values):
        self.estimates.append((self.fleet.t_s, dict(values)))

    def log(self, level, text):
        raise AssertionError(f"{level}: {text}")


class Fleet:
    """Vehicles that fly the same software."""

    def __init__(
        self,
        software: Callable,
        states,
        *,
        settings=None,
        tick_s=60.0,
        forces=("two_body", "j2"),
        ballistic=None,
        ballistic_range=(0.0, np.inf),
        duration_s=86_400.0,
        sign=1.0,
        dies_s=None,
    ):
        self.dies_s = dict(dies_s or {})
        """By index, from when on a vehicle's software and radio are silent."""
        self.states = np.array(states, dtype=np.float64)
        count = len(self.states)
        agents = tuple(f"agent-{number:03d}" for number in range(count))
        self.t_s, self.tick_s, self.ticks = 0.0, tick_s, 0
        self.air, self.waiting, self.delta_v_m_s = [], [], np.zeros(count)
        self.revision = 0
        self._parameters = PropagationParameters(
            settings=ScipyPropagator(kind="scipy", forces=forces, rtol=1e-10),
            gravity=EGM_96,
            epoch_utc=datetime(2020, 1, 1, tzinfo=UTC),
            ballistic_m2_kg=None if ballistic is None else np.full(count, ballistic),
        )
        self.vehicles = [
            Vehicle(
                self, agent, index, agents, settings or {}, duration_s, ballistic_range, sign=sign
            )
            for index, agent in enumerate(agents)
        ]
        self.software = [software() for _ in agents]
        for one, vehicle in zip(self.software, self.vehicles, strict=True):
            one.setup(vehicle)

    def run(self, until_s, watch=None, every_s=None):
        """Tick until *until_s*; *watch* is called with each watched time and the states."""
        while self.t_s < until_s - 1e-9:
            self._tick()
            if watch is not None and self.t_s % (every_s or self.tick_s) < 1e-6:
                watch(self.t_s, self.states)
            self._advance()

    def _tick(self):
        heard, self.air = self.air, []
        for sender, to, payload in heard:
            sent_s = self.t_s - self.tick_s
            name = self.vehicles[sender].name
            delivery = Delivery(
                sender=name, sent_s=sent_s, arrives_s=sent_s + 0.01, payload=payload
            )
            if self._lives(to):
                self.software[to].receive(delivery)
        for index, state in enumerate(self.states.tolist()):
            if self._lives(index):
                self.software[index].step(self.t_s, {TRUTH: Reading(self.t_s, tuple(state))})

    def _lives(self, index):
        return self.t_s < self.dies_s.get(index, np.inf)

    def _advance(self):
        """Propagate by a tick, stopping at the time of each command in it."""
        end_s = (self.ticks + 1) * self.tick_s
        due = [item for item in self.waiting if item[1].at_s < end_s]
        self.waiting = [item for item in self.waiting if item[1].at_s >= end_s]
        for at_s in sorted({command.at_s for _, command in due}):
            self._propagate(at_s)
            for index, command in due:
                if command.at_s == at_s:
                    self._execute(index, command)
        self._propagate(end_s)
        self.ticks += 1

    def _propagate(self, to_s):
        if to_s > self.t_s:
            knots_s = np.array([self.t_s, to_s])
            self.states = ScipyDop853().propagate(self.states, self.t_s, knots_s, self._parameters)[
                :, 1
            ]
            self.t_s = to_s

    def _execute(self, index, command):
        vehicle, given = self.vehicles[index], 0.0
        if command.kind == "ballistic":
            ballistic = self._parameters.ballistic_m2_kg.copy()
            low, high = vehicle.ballistic_range
            wanted = command.vector[0]
            ballistic[index] = wanted if vehicle.sign > 0.0 else low + high - wanted
            self._parameters = replace(self._parameters, ballistic_m2_kg=ballistic)
        else:
            r, v = self.states[index, :3], self.states[index, 3:]
            change = vehicle.sign * np.asarray(command.vector)
            if command.frame == "rtn":
                change = rtn_to_inertial(r, v) @ change
            self.states[index, 3:] += change
            given = float(np.linalg.norm(change))
            self.delta_v_m_s[index] += given
        self.revision += 1
        result = CommandResult(
            number=command.number, status="executed", at_s=command.at_s, revision=self.revision, delta_v_m_s=given
        )  # fmt: skip
        self.software[index].command_result(result)
