"""
Faults in a timeline's entries of a constellation: stations, sensors and actuators that are not there.

As in `check`, standard library alone: `cosmos validate` answers at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from madns_runtime.errors import ConfigurationError
from madns_runtime.plain_values import first_few
from madns_runtime.plugin.api import PlannedAction
from madns_runtime.similar_words import did_you_mean
from madns_runtime.simulations.constellation.actions import (
    DARKEN_STATION,
    FAIL_WHEELS,
    SENSOR_FAULT,
    STICK_THRUSTER_OPEN,
    TELECOMMAND,
    WEAKEN_THRUSTER,
    SensorFault,
    StuckThruster,
    Telecommand,
)
from madns_runtime.simulations.constellation.check import name_satellites
from madns_runtime.simulations.constellation.equipment import SensorNoise, Sensors, Vehicle
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.sensor_channels import VALUES, VELOCITIES
from madns_runtime.simulations.constellation.vehicles import flight_of, vehicle_of

NAMED_MAX: Final = 3
"""Agents that a fault names."""
Found = Iterator[tuple[str, str]]
"""The parameter of the action, and what is wrong with it."""


def find_action_faults(
    parameters: ConstellationParameters,
    actions: tuple[PlannedAction, ...],
    agents: tuple[str, ...],
    base_directory: Path,
) -> list[str]:
    """
    Return every fault as a line that starts with the entry's place and its parameter; see `plugin.api.Simulation`.

    Args:
        parameters: Of the scenario, within their bounds.
        actions: Entries of its timeline, within the bounds of their parameters.
        agents: Names of all agents.
        base_directory: Folder of the scenario.
    """
    try:
        satellites = name_satellites(parameters, agents, base_directory)
    except ConfigurationError:
        return []  # told by `check`, and what agents fly is open
    fleet = _Fleet(parameters, satellites)
    return [
        f"{action.place}.{key}: {text}"
        for action in actions
        if action.word in _RULES
        for key, text in _RULES[action.word](fleet, action)
    ]


@dataclass(frozen=True, slots=True)
class _Fleet:
    """Vehicles and stations as the scenario describes them."""

    parameters: ConstellationParameters
    satellites: Mapping[str, str]

    def vehicle(self, agent: str) -> Vehicle:
        return vehicle_of(self.parameters, agent, self.satellites[agent])

    def flies_software(self, agent: str) -> bool:
        return flight_of(self.parameters, agent, self.satellites[agent]) is not None

    def without(self, agents: Sequence[str], has: Callable[[Vehicle], bool]) -> str:
        """Return the names of those agents that have not what is asked for, as a message shows them."""
        return first_few([agent for agent in agents if not has(self.vehicle(agent))], NAMED_MAX)

    def station_fault(self, name: str) -> str | None:
        """Return what is wrong with a station's name."""
        known = [station.name for station in self.parameters.stations]
        if name in known:
            return None
        if not known:
            return f"no ground station {name!r}: this scenario has none, parameters.stations gives it some"
        return f"no ground station {name!r} in parameters.stations{_meant(name, known)}"


def _station_faults(fleet: _Fleet, action: PlannedAction) -> Found:
    if fault := fleet.station_fault(action.parameters.station):
        yield "station", fault


def _telecommand_faults(fleet: _Fleet, action: PlannedAction) -> Found:
    given: Telecommand = action.parameters
    if given.station is not None:
        yield from _station_faults(fleet, action)
    deaf = [agent for agent in action.agents if not fleet.flies_software(agent)]
    if deaf:
        yield (
            "agents",
            f"{first_few(deaf, NAMED_MAX)}: no flight software that could hear it; parameters.flight gives it some",
        )


def _sensor_faults(fleet: _Fleet, action: PlannedAction) -> Found:
    given: SensorFault = action.parameters
    name = given.sensor
    for agent in action.agents:
        sensors = fleet.vehicle(agent).sensors
        if not isinstance(getattr(sensors, name), SensorNoise):
            yield "sensor", _no_model(agent, name, sensors)
            break
    size = VALUES[name][1] + (VELOCITIES[1] if name == "gnss" else 0)
    if given.fault != "biased" and given.bias:
        yield "bias", f"goes with fault: biased, got {given.fault}: leave it out"
    elif given.fault == "biased" and not any(given.bias):
        yield (
            "bias" if given.bias else "fault",
            "biased needs bias: what is added to the values, other than 0",
        )
    elif len(given.bias) > size:
        yield (
            "bias",
            f"expected at most {size} numbers, of {name} {_values(name)}, got {len(given.bias)}",
        )


def _no_model(agent: str, name: str, sensors: Sensors) -> str:
    """Return why a sensor of a vehicle cannot fail so."""
    if (device := getattr(sensors, name)) is not None:
        return f"{name} of {agent} is measured by a device ({device.device}): have it fail by device_fault"
    fields = type(sensors).__dataclass_fields__
    known = [each for each in fields if isinstance(getattr(sensors, each), SensorNoise)]
    has = f"its model has {', '.join(known)}" if known else "it has no sensors"
    return f"{agent} has no {name}, {has}; parameters.vehicles.sensors gives it one"


def _values(name: str) -> str:
    unit, _ = VALUES[name]
    return f"in {unit}" if name != "gnss" else f"in {unit}, then {VELOCITIES[0]}"


def _thruster_faults(fleet: _Fleet, action: PlannedAction) -> Found:
    if named := fleet.without(action.agents, lambda vehicle: vehicle.thruster is not None):
        yield "agents", f"{named}: no thruster; parameters.vehicles.thruster gives it one"


def _stuck_faults(fleet: _Fleet, action: PlannedAction) -> Found:
    given: StuckThruster = action.parameters
    yield from _thruster_faults(fleet, action)
    propagator = fleet.parameters.propagator
    if not propagator.can_maneuver:
        yield (
            "action",
            f"{propagator.kind} follows no burn: parameters.propagator must be one that starts from any state",
        )
    if given.thrust_n is None:
        impulsive = fleet.without(
            action.agents, lambda each: each.thruster is None or each.thruster.thrust_n is not None
        )
        if impulsive:
            yield "action", f"{impulsive}: its burns are impulses, so give thrust_n, N"
    if not math.hypot(*given.direction):
        yield "direction", "expected a direction, got 0, 0, 0"
    if given.frame == "body":
        points = fleet.without(action.agents, lambda each: each.attitude is not None)
        if points:
            yield (
                "frame",
                f"{points}: no body axes; parameters.vehicles.attitude gives it some, or take rtn",
            )


def _wheel_faults(fleet: _Fleet, action: PlannedAction) -> Found:
    if points := fleet.without(action.agents, lambda vehicle: vehicle.attitude is not None):
        yield (
            "agents",
            f"{points}: no wheels, as it has no attitude; parameters.vehicles.attitude gives it one",
        )


_RULES: Final[Mapping[str, Callable[[_Fleet, PlannedAction], Found]]] = {
    DARKEN_STATION.word: _station_faults,
    TELECOMMAND.word: _telecommand_faults,
    SENSOR_FAULT.word: _sensor_faults,
    WEAKEN_THRUSTER.word: _thruster_faults,
    STICK_THRUSTER_OPEN.word: _stuck_faults,
    FAIL_WHEELS.word: _wheel_faults,
}


def _meant(name: str, known: Sequence[str]) -> str:
    return did_you_mean(name, known) or f"; there are {', '.join(known)}"
