"""Faults in what a scenario says of vehicles, their sensors and flight software, and of the ground."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Sequence
from pathlib import Path

from madns_runtime.simulations.constellation.check_code import code_faults
from madns_runtime.simulations.constellation.equipment import SensorNoise, Vehicle
from madns_runtime.simulations.constellation.flight.programs import find_program
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    FlightProcess,
)
from madns_runtime.simulations.constellation.vehicles import fits

_HERE = "madns_runtime.simulations.constellation"
WALL = tuple(f"{_HERE}.{part}" for part in ("truth", "vehicle", "hosting", "host", "agent"))
"""What flight software does not import: all that knows truth."""
PENDING_MAX = 10_000
"""Measurements that a sensor may have under way: see vehicle.sensors.sensor."""


def board_faults(
    parameters: ConstellationParameters, names: Sequence[tuple[str, str]], base_directory: Path
) -> list[str]:
    """
    Return the faults.

    Args:
        parameters: Of the scenario, within their bounds.
        names: Names of each agent and of its satellite; empty if they are not known.
        base_directory: Folder of the scenario.
    """
    faults = []
    for number, vehicle in enumerate(parameters.vehicles):
        field = f"parameters.vehicles[{number}]"
        faults += glob_faults(f"{field}.agents", vehicle.agents, names)
        faults += _body_faults(field, vehicle)
        faults += _sensor_faults(field, vehicle)
    faults += _flight_faults(parameters, names, base_directory)
    faults += _ground_faults(parameters, names)
    return faults


def glob_faults(field: str, globs: Iterable[str], names: Sequence[tuple[str, str]]) -> list[str]:
    """Return a fault for each glob that fits nobody."""
    if not names:
        return []
    return [
        f"{field}: {glob!r} fits no agent and no satellite, such as {names[0][0]} or {names[0][1]}"
        for glob in globs
        if not any(fits((glob,), agent, satellite) for agent, satellite in names)
    ]


def _body_faults(field: str, vehicle: Vehicle) -> list[str]:
    faults = []
    thruster, limits = vehicle.thruster, vehicle.ballistic_m2_kg_range
    if thruster is not None and thruster.propellant_kg >= vehicle.mass_kg:
        faults.append(
            f"{field}.thruster.propellant_kg: expected less than the vehicle's mass_kg, "
            f"{vehicle.mass_kg:g}, got {thruster.propellant_kg:g}"
        )
    if limits is not None and not 0.0 <= limits[0] <= vehicle.ballistic_m2_kg <= limits[1]:
        faults.append(
            f"{field}.ballistic_m2_kg_range: expected smallest and largest, and ballistic_m2_kg "
            f"({vehicle.ballistic_m2_kg:g}) between them, got {limits[0]:g} to {limits[1]:g}"
        )
    if vehicle.attitude is not None:
        a, b, c = sorted(vehicle.attitude.inertia_kg_m2)
        if a + b < c:
            faults.append(
                f"{field}.attitude.inertia_kg_m2: no body has moments of which one exceeds the sum "
                f"of the others, got {a:g}, {b:g} and {c:g}"
            )
    return faults


def _sensor_faults(field: str, vehicle: Vehicle) -> list[str]:
    sensors = vehicle.sensors
    faults = [
        f"{field}.sensors.{name}: needs a vehicle with attitude"
        for name in ("gyro", "star_tracker")
        if getattr(sensors, name) is not None and vehicle.attitude is None
    ]
    for name in type(sensors).__dataclass_fields__:
        sensor: SensorNoise | None = getattr(sensors, name)
        if sensor is not None and sensor.latency_s * sensor.rate_hz > PENDING_MAX:
            faults.append(
                f"{field}.sensors.{name}.latency_s: expected at most {PENDING_MAX} measurements "
                f"under way, got {sensor.latency_s * sensor.rate_hz:g}"
            )
    magnetometer = sensors.magnetometer
    wants_igrf = magnetometer is not None and magnetometer.field == "igrf"
    if wants_igrf and importlib.util.find_spec("ppigrf") is None:
        faults.append(
            f"{field}.sensors.magnetometer.field: ppigrf is not installed here; "
            "install it with: pip install 'cosmos-madns[igrf]'"
        )
    return faults


def _flight_faults(
    parameters: ConstellationParameters, names: Sequence[tuple[str, str]], base_directory: Path
) -> list[str]:
    flight = parameters.flight
    if flight is None:
        return []
    if isinstance(flight, str):
        return code_faults("parameters.flight", flight, base_directory, forbidden=WALL)
    faults = glob_faults("parameters.flight.agents", flight.agents, names)
    if isinstance(flight, FlightProcess):
        return faults + _program_faults(flight.command[0], base_directory)
    field, software = "parameters.flight.software", flight.software
    return faults + code_faults(field, software, base_directory, forbidden=WALL)


def _program_faults(program: str, base_directory: Path) -> list[str]:
    """Return what is wrong with a program; an absolute path may exist on the boards alone."""
    if Path(program).is_absolute() or find_program((program,), base_directory) is not None:
        return []
    path = base_directory / program
    if path.is_file():
        return [f"parameters.flight.command: {path} is not executable; chmod +x makes it so"]
    where = base_directory if "/" in program else f"{base_directory} or on PATH"
    return [f"parameters.flight.command: no program {program!r} in {where}"]


def _ground_faults(
    parameters: ConstellationParameters, names: Sequence[tuple[str, str]]
) -> list[str]:
    faults = []
    known: set[str] = set()
    for number, station in enumerate(parameters.stations):
        if station.name in known:
            field = f"parameters.stations[{number}].name"
            faults.append(f"{field}: expected every name once, got {station.name!r} again")
        known.add(station.name)
    if parameters.uplinks and not parameters.stations:
        faults.append("parameters.uplinks: need parameters.stations to leave from")
    receivers = {name for pair in names for name in pair}
    for number, uplink in enumerate(parameters.uplinks):
        if receivers and uplink.to not in receivers:
            field = f"parameters.uplinks[{number}].to"
            faults.append(f"{field}: no agent and no satellite is called {uplink.to!r}")
    return faults
