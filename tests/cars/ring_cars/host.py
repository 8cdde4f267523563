"""The host's half: the road, and the medium of what cars say to each other."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from madns_runtime.medium.links import LinkMedium
from madns_runtime.plugin.api import Check, HostContext, HostSimulation, TimelineAction
from ring_cars.streams import ROAD

STEP_S = 0.05
RECORD_STEPS = 4


class RingRoad(HostSimulation):
    """Moves the cars and measures for them."""

    def setup(self, context: HostContext) -> None:
        """Spread the cars; the first stands."""
        self._context = context
        self._parameters = context.parameters
        self._cars = context.agents
        count = len(self._cars)
        spaces_m = itertools.cycle(self._parameters.spaces_m or (self._parameters.ring_m / count,))
        behind_m = itertools.accumulate(itertools.islice(spaces_m, count - 1), initial=0.0)
        self._driven_m = [-each_m for each_m in behind_m]
        self._speed_m_s = [0.0, *[self._parameters.speed_m_s] * (count - 1)]
        self._command_m_s2 = [0.0] * count
        self._refused = 0
        self._braking: dict[int, float] = {}
        """By car: how hard it brakes, m/s^2."""
        self._gap_m_min, self._closest = math.inf, ""
        self._steps = 0
        context.open_stream("road", ROAD)

    def initial_data(self, agent: str) -> Mapping[str, Any]:
        """Return where a car starts, and where the car ahead does."""
        car = self._cars.index(agent)
        return {"own": self._state(car), "ahead": self._state_ahead(car)}

    def timer(self, t_s: float) -> float:
        """Move by one step, record and measure."""
        if t_s >= 0.0:
            self._move()
        for car, name in enumerate(self._cars):
            gap_m = self._gap_m(car)
            if gap_m < self._gap_m_min:
                self._gap_m_min, self._closest = gap_m, name
            if self._steps % RECORD_STEPS == 0:
                state = (self._driven_m[car], self._speed_m_s[car], gap_m)
                self._context.record("road", (t_s, name, *state))
            self._context.send(name, {"own": self._state(car)})
        self._steps += 1
        return t_s + STEP_S

    def receive(self, agent: str, message: Any) -> None:
        """Take a command."""
        wanted = float(message["acceleration_m_s2"])
        if not math.isfinite(wanted):
            self._refused += 1
            return
        self._command_m_s2[self._cars.index(agent)] = max(-9.0, min(3.0, wanted))

    def begin_action(self, action: TimelineAction) -> None:
        """Have cars brake."""
        for name in action.agents:
            self._braking[self._cars.index(name)] = action.parameters.deceleration_m_s2

    def end_action(self, action: TimelineAction) -> None:
        """Let them drive on."""
        for name in action.agents:
            self._braking.pop(self._cars.index(name), None)

    def reach(self, sender: str, receiver: str, t_s: float) -> str | None:
        """Return why a car cannot hear another; None if it can. On a ring, the shorter way counts."""
        ring_m = self._parameters.ring_m
        apart_m = abs(
            self._driven_m[self._cars.index(sender)] - self._driven_m[self._cars.index(receiver)]
        )
        apart_m %= ring_m
        return (
            None if min(apart_m, ring_m - apart_m) <= self._parameters.reach_m else "out_of_range"
        )

    def finish(self) -> Mapping[str, Any]:
        """Return the smallest gap: less than nothing is a collision."""
        collisions = Check(
            name="gap_m",
            limit=0.0,
            got=self._gap_m_min,
            passed=self._gap_m_min > 0.0,
            worst=self._closest,
        )
        refused = Check(
            name="commands_refused", limit=0, got=self._refused, passed=self._refused == 0
        )
        return {"gap_m_min": self._gap_m_min, "checks": [asdict(collisions), asdict(refused)]}

    def _move(self) -> None:
        for car, command_m_s2 in enumerate(self._command_m_s2):
            if car in self._braking:
                command_m_s2 = -self._braking[car]  # noqa: PLW2901 - the driver is not asked
            before_m_s = self._speed_m_s[car]
            after_m_s = max(0.0, before_m_s + command_m_s2 * STEP_S)
            self._driven_m[car] += 0.5 * (before_m_s + after_m_s) * STEP_S
            self._speed_m_s[car] = after_m_s

    def _state(self, car: int) -> list[float]:
        return [self._driven_m[car], self._speed_m_s[car]]

    def _state_ahead(self, car: int) -> list[float]:
        """Return how far the car ahead is on this car's count, and its speed."""
        driven_m, speed_m_s = self._state(car - 1)
        return [driven_m + (self._parameters.ring_m if car == 0 else 0.0), speed_m_s]

    def _gap_m(self, car: int) -> float:
        return self._state_ahead(car)[0] - self._driven_m[car] - self._parameters.car_m


def v2v(road: RingRoad, context: HostContext) -> LinkMedium:
    """Return the medium between the cars; see `plugin.api.Simulation`."""
    parameters = context.parameters
    return LinkMedium(
        context.agents,
        context.random,
        delay_s=parameters.radio_delay_s,
        reach=road.reach,
        rate_byte_s=parameters.rate_byte_s,
        loss=parameters.loss,
    )
