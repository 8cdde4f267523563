"""
Which description of a vehicle, and which flight software, an agent has. Pure; both sides ask here.

Globs name agents or satellites: the operator knows one or the other, and both are written in a scenario.
"""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    FlightProcess,
    FlightSoftware,
)

DEFAULT = Vehicle()
"""What a vehicle is like that no entry describes."""


def vehicle_of(parameters: ConstellationParameters, agent: str, satellite: str) -> Vehicle:
    """Return the first entry of *parameters.vehicles* that fits an agent or its satellite; the default one if none does."""
    for vehicle in parameters.vehicles:
        if fits(vehicle.agents, agent, satellite):
            return vehicle
    return DEFAULT


def flight_of(
    parameters: ConstellationParameters, agent: str, satellite: str
) -> FlightSoftware | FlightProcess | None:
    """Return the flight software that an agent flies, or None for a vehicle that only coasts."""
    flight = flight_settings(parameters)
    if flight is None or not fits(flight.agents, agent, satellite):
        return None
    return flight


def flight_settings(
    parameters: ConstellationParameters,
) -> FlightSoftware | FlightProcess | None:
    """Return the scenario's flight software, with its short form file.py:Class written out."""
    flight = parameters.flight
    return FlightSoftware(software=flight) if isinstance(flight, str) else flight


def fits(globs: Iterable[str], agent: str, satellite: str) -> bool:
    """Tell whether one of *globs* is, or matches, an agent's or its satellite's name; case counts."""
    names = (agent, satellite)
    return any(
        glob in names or fnmatchcase(agent, glob) or fnmatchcase(satellite, glob) for glob in globs
    )
