"""Failures that a timeline orders of the constellation's host: of actuators and of ground stations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from madns_runtime.plugin.api import ActionRefused, TimelineAction
from madns_runtime.simulations.constellation.actions import (
    DARKEN_STATION,
    FAIL_WHEELS,
    STICK_THRUSTER_OPEN,
    WEAKEN_THRUSTER,
    DarkStation,
)
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.host_side.maneuver_execution import Maneuvering
from madns_runtime.simulations.constellation.host_side.radio import RadioMedium


class InjectedFailures:
    """
    Puts failures in force, and lifts them.

    Args:
        maneuvering: Returns who changes truth.
        index: Number of each agent's vehicle.
        vehicles: What each is like.
        radio: Knows the ground stations; None without any.
    """

    def __init__(
        self,
        maneuvering: Callable[[], Maneuvering],
        index: Mapping[str, int],
        *,
        vehicles: Sequence[Vehicle],
        radio: RadioMedium | None,
    ) -> None:
        self._maneuvering = maneuvering
        self._index = index
        self._vehicles = vehicles
        self._radio = radio

    def begin(self, action: TimelineAction) -> None:
        """
        Put a failure in force.

        Raises:
            ActionRefused: A vehicle has no such actuator, or there is no such station.
        """
        given: Any = action.parameters
        vehicles = [self._index[agent] for agent in action.agents]
        if action.word == DARKEN_STATION.word:
            self._darken(action, is_dark=True)
        elif action.word == WEAKEN_THRUSTER.word:
            self._need(action, vehicles, "thruster")
            factors = dict.fromkeys(vehicles, given.factor)
            self._maneuvering().failures.weaken(action.number, factors)
        elif action.word == STICK_THRUSTER_OPEN.word:
            self._need(action, vehicles, "thruster")
            self._maneuvering().stuck.begin(action.number, vehicles, given)
        elif action.word == FAIL_WHEELS.word:
            self._need(action, vehicles, "attitude")
            self._maneuvering().failures.fail_wheels(action.number, frozenset(vehicles))

    def end(self, action: TimelineAction) -> None:
        """Lift a failure."""
        if action.word == DARKEN_STATION.word:
            self._darken(action, is_dark=False)
        elif action.word == STICK_THRUSTER_OPEN.word:
            self._maneuvering().stuck.end(action.number)
        else:
            self._maneuvering().failures.lift(action.number)

    def _need(self, action: TimelineAction, vehicles: Sequence[int], part: str) -> None:
        lacking = [
            agent
            for agent, vehicle in zip(action.agents, vehicles, strict=True)
            if getattr(self._vehicles[vehicle], part) is None
        ]
        if lacking:
            named = "attitude" if part == "attitude" else "a thruster"
            raise ActionRefused(f"without {named} in parameters.vehicles: {', '.join(lacking)}")

    def _darken(self, action: TimelineAction, *, is_dark: bool) -> None:
        given: DarkStation = action.parameters  # type: ignore[assignment]
        if self._radio is None or not self._radio.darken(given.station, is_dark=is_dark):
            raise ActionRefused(f"no ground station named {given.station!r} in this scenario")
