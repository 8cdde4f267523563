"""
Description and flight software of each agent's vehicle. Pure; both sides ask here.

Globs name agents or satellites: the operator knows one or the other, and both are written in a scenario.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterable
from functools import lru_cache

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    FlightClass,
    FlightProcess,
)

GLOBS_KEPT = 1024
"""Lists of globs that are kept sorted out: each is asked for every agent."""
DEFAULT = Vehicle()
"""Description of a vehicle that no entry describes."""


def vehicle_of(parameters: ConstellationParameters, agent: str, satellite: str) -> Vehicle:
    """Return the first entry of *parameters.vehicles* that fits an agent or its satellite; the default one if none does."""
    for vehicle in parameters.vehicles:
        if fits(vehicle.agents, agent, satellite):
            return vehicle
    return DEFAULT


def flight_of(
    parameters: ConstellationParameters, agent: str, satellite: str
) -> FlightClass | FlightProcess | None:
    """Return the flight software that an agent flies, or None for a vehicle that only coasts."""
    flight = flight_settings(parameters)
    if flight is None or not fits(flight.agents, agent, satellite):
        return None
    return flight


def flight_settings(
    parameters: ConstellationParameters,
) -> FlightClass | FlightProcess | None:
    """Return the scenario's flight software, with its short form file.py:Class written out."""
    flight = parameters.flight
    return FlightClass(software=flight) if isinstance(flight, str) else flight


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
