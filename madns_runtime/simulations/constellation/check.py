"""
Faults of a constellation scenario that bounds cannot tell, found before anything is launched.

Imports neither scipy nor sgp4: `cosmos validate` answers at once.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.check_board import board_faults
from madns_runtime.simulations.constellation.check_code import code_faults
from madns_runtime.simulations.constellation.parameters import (
    KNOTS_MAX,
    BasiliskPropagator,
    ConstellationParameters,
    CustomPropagator,
    ElementSetSatellites,
    Sgp4Propagator,
)
from madns_runtime.simulations.constellation.truth.choice import choose

LIBRARIES = {
    "scipy": ("scipy", "host"),
    "sgp4": ("sgp4", "host"),
    "numba": ("numba", "fast"),
    "basilisk": ("Basilisk", "basilisk"),
}
"""By the kind of propagator: the module that it needs, and the extra that brings it."""


def find_faults(
    parameters: ConstellationParameters,
    agents: int,
    base_directory: Path,
    names: tuple[str, ...] = (),
) -> list[str]:
    """
    Return every fault as a line that starts with the dotted parameter name and a colon.

    Args:
        parameters: Of the scenario, within their bounds.
        agents: Number of agents, each of which needs a satellite.
        base_directory: Folder of the scenario.
        names: The agents' names; globs are not judged without them.
    """
    faults: list[str] = []
    folder = Path(base_directory)
    pairs: list[tuple[str, str]] = []
    try:
        satellites = choose(parameters, agents, folder).names
        pairs = list(zip(names, satellites, strict=False))
    except ConfigurationError as error:
        faults += str(error).splitlines()
    faults += _propagator_faults(parameters, folder)
    faults += _segment_faults(parameters)
    faults += _attitude_faults(parameters)
    faults += _missing_libraries(parameters)
    faults += board_faults(parameters, pairs, folder)
    return faults


def _propagator_faults(parameters: ConstellationParameters, base_directory: Path) -> list[str]:
    propagator = parameters.propagator
    if isinstance(propagator, CustomPropagator):
        field = "parameters.propagator.implementation"
        return code_faults(field, propagator.implementation, base_directory)
    if not isinstance(propagator, Sgp4Propagator):
        faults = []
        if "two_body" not in propagator.forces:
            faults.append("parameters.propagator.forces: expected two_body among them")
        if len(set(propagator.forces)) < len(propagator.forces):
            faults.append("parameters.propagator.forces: expected every force once")
        return faults
    if isinstance(parameters.satellites, ElementSetSatellites):
        return []
    return [
        "parameters.propagator.kind: sgp4 needs element sets, give satellites.elements; "
        "patterns and Keplerian elements need kind: scipy"
    ]


def _segment_faults(parameters: ConstellationParameters) -> list[str]:
    knot_s, buffer_s = parameters.segments.knot_s, parameters.segments.buffer_s
    intervals = buffer_s / 2.0 / knot_s
    if intervals < 0.5 or abs(intervals - round(intervals)) > 1e-6:
        return [
            "parameters.segments.knot_s: expected half of buffer_s to be a whole number of knots, "
            f"got {buffer_s / 2.0:g} s and {knot_s:g} s"
        ]
    if 2 * intervals + 1 > KNOTS_MAX:
        return [f"parameters.segments.buffer_s: expected at most {KNOTS_MAX} knots in a buffer"]
    return []


def _attitude_faults(parameters: ConstellationParameters) -> list[str]:
    """Return rigid bodies that the propagator cannot do, or that turn too fast for the knots."""
    faults = []
    by_basilisk = isinstance(parameters.propagator, BasiliskPropagator)
    for number, vehicle in enumerate(parameters.vehicles):
        attitude, field = vehicle.attitude, f"parameters.vehicles[{number}].attitude"
        if attitude is None:
            continue
        if by_basilisk and attitude.wheels is not None:
            faults.append(
                f"{field}.wheels: basilisk does rigid bodies without wheels only; drop them, which "
                "makes torques exact and without limit, or take kind: scipy or numba"
            )
        turn_deg = math.hypot(*attitude.rates_deg_s) * parameters.segments.knot_s
        if turn_deg >= 180.0:
            faults.append(
                f"{field}.rates_deg_s: expected less than half a turn between knots, got "
                f"{turn_deg:g} deg; a shorter segments.knot_s follows faster ones"
            )
    return faults


def _missing_libraries(parameters: ConstellationParameters) -> list[str]:
    wanted = {parameters.propagator.kind: "parameters.propagator.kind"}
    if isinstance(parameters.satellites, ElementSetSatellites):
        wanted["sgp4"] = "parameters.satellites.elements"
    faults = []
    for kind, field in wanted.items():
        module, extra = LIBRARIES.get(kind, (None, None))
        if module is not None and importlib.util.find_spec(module) is None:
            install = f"pip install 'cosmos-madns[{extra}]'"
            faults.append(f"{field}: {module} is not installed here; install it with: {install}")
    return faults
