"""Failures that a timeline orders of the constellation's host: of actuators and of ground stations."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

from madns_runtime.plugin.api import ActionRefused, HostContext, TimelineAction
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.actions import (
    DARKEN_STATION,
    FAIL_WHEELS,
    LOSE_SATELLITE,
    STICK_THRUSTER_OPEN,
    TELECOMMAND,
    WEAKEN_THRUSTER,
    DarkStation,
    Telecommand,
)
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.host_side.maneuver_execution import Maneuvering
from madns_runtime.simulations.constellation.host_side.radio import RadioMedium
from madns_runtime.simulations.constellation.messages import GroundText, SatelliteLoss
from madns_runtime.simulations.constellation.parameters import Uplink


class InjectedFailures:
    """
    Puts failures in force, and lifts them.

    Args:
        maneuvering: Returns who changes truth.
        context: Through which agents are told.
        vehicles: What each is like.
        radio: Knows the ground stations; None without any.
        gone: Agents that are lost at present.
    """

    def __init__(
        self,
        maneuvering: Callable[[], Maneuvering],
        context: HostContext,
        *,
        vehicles: Sequence[Vehicle],
        radio: RadioMedium | None,
        gone: Collection[str],
    ) -> None:
        self._maneuvering = maneuvering
        self._context = context
        self._index = {agent: number for number, agent in enumerate(context.agents)}
        self._vehicles = vehicles
        self._radio = radio
        self._gone = gone
        self._lost: dict[int, tuple[str, ...]] = {}
        """By action the agents whose satellites are lost."""
        self._dark: dict[int, str] = {}
        """By action the station that it darkens; several may darken one."""

    def begin(self, action: TimelineAction) -> None:
        """
        Put a failure in force.

        Raises:
            ActionRefused: A vehicle has no such actuator, there is no such station, or all who would hear it are lost.
        """
        given: Any = action.parameters
        vehicles = [self._index[agent] for agent in action.agents]
        if action.word == DARKEN_STATION.word:
            self._darken(action, is_dark=True)
        elif action.word == TELECOMMAND.word:
            self._telecommand(action, given)
        elif action.word == LOSE_SATELLITE.word:
            self._lost[action.number] = action.agents
            self._tell_losses(action.agents)
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
        elif action.word == LOSE_SATELLITE.word:
            self._tell_losses(self._lost.pop(action.number))
        elif action.word == STICK_THRUSTER_OPEN.word:
            self._maneuvering().stuck.end(action.number)
        else:
            self._maneuvering().failures.lift(action.number)

    def rejoined(self, agent: str) -> None:
        """Tell an agent that has returned what its satellite is."""
        if agent in self.lost:
            self._tell_losses((agent,))

    @property
    def lost(self) -> frozenset[str]:
        """Agents whose satellites are lost at present."""
        return frozenset(agent for agents in self._lost.values() for agent in agents)

    def _tell_losses(self, agents: Sequence[str]) -> None:
        lost = self.lost
        if self._radio is not None:
            self._radio.lost = lost
        for agent in agents:
            told = SatelliteLoss(is_lost=agent in lost).to_message()
            self._context.send(agent, told, Service.RELIABLE)

    def _telecommand(self, action: TimelineAction, given: Telecommand) -> None:
        if given.station is None:
            if all(agent in self._gone for agent in action.agents):
                raise ActionRefused(f"nobody hears it at present: {', '.join(action.agents)}")
            text = GroundText(t_s=self._context.now_s(), text=given.text).to_message()
            for agent in action.agents:
                self._context.send(agent, text, Service.RELIABLE)
            return
        now_s = self._context.now_s()
        for agent in action.agents:
            uplink = Uplink(at_s=now_s, to=agent, text=given.text)
            if self._radio is None or not self._radio.uplink(uplink, given.station):
                raise ActionRefused(f"no ground station named {given.station!r} in this scenario")

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
        given: DarkStation = action.parameters  # type: ignore[assignment]  # an instance of its kind's class
        if is_dark:
            self._dark[action.number] = given.station
        else:
            self._dark.pop(action.number, None)
        stays_dark = given.station in self._dark.values()
        if self._radio is None or not self._radio.darken(given.station, is_dark=stays_dark):
            self._dark.pop(action.number, None)
            raise ActionRefused(f"no ground station named {given.station!r} in this scenario")
