"""Failures that a timeline orders of the constellation's host: of actuators and of ground stations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from madns_runtime.plugin.api import ActionRefused, TimelineAction
from madns_runtime.simulations.constellation.actions import (
    DARKEN_STATION,
    FAIL_WHEELS,
    WEAKEN_THRUSTER,
    DarkStation,
    WeakThruster,
)
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.host_side.radio import RadioMedium
from madns_runtime.simulations.constellation.truth.maneuvers.actuator_failures import (
    ActuatorFailures,
)


class InjectedFailures:
    """
    Puts failures in force, and lifts them.

    Args:
        failures: Of the actuators.
        index: Number of each agent's vehicle.
        vehicles: What each is like.
        radio: Knows the ground stations; None without any.
    """

    def __init__(
        self,
        failures: ActuatorFailures,
        index: Mapping[str, int],
        vehicles: Sequence[Vehicle],
        radio: RadioMedium | None,
    ) -> None:
        self._failures = failures
        self._index = index
        self._vehicles = vehicles
        self._radio = radio

    def begin(self, action: TimelineAction) -> None:
        """
        Put a failure in force.

        Raises:
            ActionRefused: A vehicle has no such actuator, or there is no such station.
        """
        if action.word == DARKEN_STATION.word:
            self._darken(action, is_dark=True)
            return
        vehicles = [self._index[agent] for agent in action.agents]
        if action.word == WEAKEN_THRUSTER.word:
            self._need(action, vehicles, "thruster")
            given: WeakThruster = action.parameters  # type: ignore[assignment]
            self._failures.weaken(action.number, dict.fromkeys(vehicles, given.factor))
        elif action.word == FAIL_WHEELS.word:
            self._need(action, vehicles, "attitude")
            self._failures.fail_wheels(action.number, frozenset(vehicles))

    def end(self, action: TimelineAction) -> None:
        """Lift a failure."""
        if action.word == DARKEN_STATION.word:
            self._darken(action, is_dark=False)
        else:
            self._failures.lift(action.number)

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
