"""
Description and flight software of each agent's vehicle. Pure; both sides ask here.

Globs name agents or satellites: the operator knows one or the other, and both are written in a scenario.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterable
from functools import lru_cache

from madns_runtime.simulations.constellation.equipment import FieldName, MagnetometerDevice, Vehicle
from madns_runtime.simulations.constellation.flight_settings import FlightClass, FlightRule
from madns_runtime.simulations.constellation.parameters import ConstellationParameters

GLOBS_KEPT = 1024
"""Lists of globs that are kept sorted out: each is asked for every agent."""
EVEN_SLOTS = "even"
"""Value of the setting slots of flight software that keeps its agents evenly spaced, in their order."""
SLOTS = (EVEN_SLOTS, "kept")
"""Values of the setting slots."""
DEFAULT = Vehicle()
"""Description of a vehicle that no entry describes."""


def vehicle_of(parameters: ConstellationParameters, agent: str, satellite: str) -> Vehicle:
    """Return the first entry of *parameters.vehicles* that fits an agent or its satellite; the default one if none does."""
    for vehicle in parameters.vehicles:
        if fits(vehicle.agents, agent, satellite):
            return vehicle
    return DEFAULT


def field_of(vehicle: Vehicle) -> FieldName:
    """Return the Earth's field by which magnetorquers turn a vehicle: as they say, else as its magnetometer does."""
    torquers = None if vehicle.attitude is None else vehicle.attitude.magnetorquers
    magnetometer = vehicle.sensors.magnetometer
    if isinstance(magnetometer, MagnetometerDevice):
        magnetometer = magnetometer.model
    measured: FieldName = "dipole" if magnetometer is None else magnetometer.field
    return measured if torquers is None or torquers.field is None else torquers.field


def flight_of(parameters: ConstellationParameters, agent: str, satellite: str) -> FlightRule | None:
    """Return the first rule of flight software that fits an agent or its satellite; None for a vehicle that only coasts."""
    for rule in flight_rules(parameters):
        if fits(rule.agents, agent, satellite):
            return rule
    return None


def flight_rules(parameters: ConstellationParameters) -> tuple[FlightRule, ...]:
    """Return the scenario's rules of flight software, with their short form file.py:Class written out."""
    flight = parameters.flight
    rules = flight if isinstance(flight, tuple) else () if flight is None else (flight,)
    return tuple(FlightClass(software=rule) if isinstance(rule, str) else rule for rule in rules)


def rules_with_even_slots(parameters: ConstellationParameters) -> tuple[FlightRule, ...]:
    """Return the rules of flight software whose settings give evenly spaced slots."""
    return tuple(
        rule for rule in flight_rules(parameters) if rule.settings.get("slots") == EVEN_SLOTS
    )


def fits(globs: Iterable[str], agent: str, satellite: str) -> bool:
    """Tell whether one of *globs* is, or matches, an agent's or its satellite's name; case counts."""
    plain, patterns = _sorted_out(tuple(globs))
    return not plain.isdisjoint((agent, satellite)) or any(
        pattern.match(agent) or pattern.match(satellite) for pattern in patterns
    )


@lru_cache(maxsize=GLOBS_KEPT)
def _sorted_out(globs: tuple[str, ...]) -> tuple[frozenset[str], tuple[re.Pattern[str], ...]]:
    """Return the names among globs, each of which means itself at least, and patterns of those that may mean more."""
    patterns = (fnmatch.translate(glob) for glob in globs if is_glob(glob))
    return frozenset(globs), tuple(map(re.compile, patterns))


def is_glob(text: str) -> bool:
    """Tell whether a text may mean another name than itself."""
    return any(character in text for character in "*?[")
