"""
Faults of a constellation scenario that bounds cannot tell, found before anything is launched.

Element sets have faults that their syntax does not show: SGP4 itself is asked, from the scenario's start to its end.
Imports neither scipy nor numpy: `cosmos validate` answers at once.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.plugin.api import DeviceUse, PlaceUse
from madns_runtime.simulations.constellation.check_flight import flight_faults, rate_faults
from madns_runtime.simulations.constellation.check_slots import node_faults, slot_record_faults
from madns_runtime.simulations.constellation.check_vehicles import (
    board_faults,
    code_faults,
    field_year_remarks,
)
from madns_runtime.simulations.constellation.device_uses import uses_devices, uses_of
from madns_runtime.simulations.constellation.parameters import (
    KNOTS_MAX,
    PROPAGATORS,
    ConstellationParameters,
    CustomPropagator,
    ElementSetSatellites,
    PropagatorProperties,
    Sgp4Propagator,
)
from madns_runtime.simulations.constellation.place_uses import place_uses_of, uses_places
from madns_runtime.simulations.constellation.truth.element_set import ElementSet
from madns_runtime.simulations.constellation.truth.satellite_selection import (
    SatelliteSelection,
    choose,
)
from madns_runtime.simulations.constellation.vehicle.truth_buffer import (
    KNOTS_HELD_MAX,
    SEGMENTS_MAX,
)
from madns_runtime.simulations.constellation.vehicles import DEFAULT

FIELD = "parameters.satellites.elements"
AGE_DAYS_MAX = 366.0
"""Between a set's epoch and the scenario's start. SGP4 is off by kilometres a day, after months by its whole orbit."""
FAULTS_MAX = 20
"""Satellites that are named."""
SEGMENTS_AHEAD = 8
"""Segments that an agent must have room for beside those that come between two ticks."""
WINDOWS_AHEAD = 3.5
"""The same in windows: the one under way, up to two and a half that were sent ahead."""


def find_faults(  # noqa: PLR0913 - what a scenario is, most by name; see plugin.api.Simulation.check
    parameters: ConstellationParameters,
    agents: int,
    base_directory: Path,
    *,
    names: tuple[str, ...] = (),
    duration_s: float = 0.0,
    is_lockstep: bool = False,
    tick_hz: float = 0.0,
) -> list[str]:
    """
    Return every fault as a line that starts with the dotted parameter name and a colon; of a remark "remark: " is before that.

    Args:
        parameters: Of the scenario, within their bounds.
        agents: Number of agents, each of which needs a satellite.
        base_directory: Folder of the scenario.
        names: The agents' names; globs are not judged without them.
        duration_s: Of the run: SGP4 is asked for all of it.
        is_lockstep: Whether simulated time waits for everybody.
        tick_hz: Of the ticks; rates are not judged without it.
    """
    faults: list[str] = []
    folder = Path(base_directory)
    pairs: list[tuple[str, str]] = []
    try:
        chosen = choose(parameters, agents, folder)
        pairs = list(zip(names, chosen.names, strict=False))
        faults += set_faults(parameters, chosen, duration_s)
        faults += field_year_remarks(parameters, chosen.epoch_utc)
        faults += node_faults(parameters, chosen, names)
    except ConfigurationError as error:
        faults += str(error).splitlines()
    faults += _propagator_faults(parameters, folder)
    faults += _segment_faults(parameters) or _slow_tick_faults(parameters, tick_hz, duration_s)
    faults += _attitude_faults(parameters)
    faults += _missing_libraries(parameters)
    faults += board_faults(parameters, pairs)
    faults += flight_faults(parameters, pairs, folder, is_lockstep=is_lockstep)
    faults += rate_faults(parameters, tick_hz)
    faults += slot_record_faults(parameters)
    faults += _late_uplinks(parameters, duration_s)
    faults += _idle_coefficients(parameters)
    if parameters.recorded_agents is not None and not is_lockstep:
        faults.append(
            "parameters.recorded_agents: expected time.mode lockstep: in real time results come when they come"
        )
    return faults


def name_satellites(
    parameters: ConstellationParameters, agents: tuple[str, ...], base_directory: Path
) -> dict[str, str]:
    """
    Return the name of each agent's satellite; see `plugin.api.Simulation`.

    Raises:
        ConfigurationError: The satellites cannot be chosen, for the reasons that `find_faults` tells.
    """
    chosen = choose(parameters, len(agents), Path(base_directory))
    return dict(zip(agents, chosen.names, strict=True))


def device_uses(
    parameters: ConstellationParameters, agents: tuple[str, ...], base_directory: Path
) -> list[DeviceUse]:
    """
    Return the channels of devices that vehicles use; see `plugin.api.Simulation`.

    Raises:
        ConfigurationError: The satellites cannot be chosen.
    """
    if not uses_devices(parameters):
        return []
    satellites = name_satellites(parameters, agents, base_directory)
    return [
        use
        for index, (agent, satellite) in enumerate(satellites.items())
        for use in uses_of(parameters, agent, index, satellite)
    ]


def place_uses(
    parameters: ConstellationParameters, agents: tuple[str, ...], base_directory: Path
) -> list[PlaceUse]:
    """
    Return what vehicles take of their machines for themselves; see `plugin.api.Simulation`.

    Raises:
        ConfigurationError: The satellites cannot be chosen.
    """
    if not uses_places(parameters):
        return []
    satellites = name_satellites(parameters, agents, base_directory)
    return list(place_uses_of(parameters, satellites, Path(base_directory)))


def _propagator_faults(parameters: ConstellationParameters, base_directory: Path) -> list[str]:
    propagator = parameters.propagator
    if isinstance(propagator, CustomPropagator):
        field = "parameters.propagator.implementation"
        return code_faults(field, propagator.implementation, base_directory)
    if not propagator.PROPERTIES.needs_element_sets:
        faults = []
        if "two_body" not in propagator.forces:
            faults.append("parameters.propagator.forces: expected two_body among them")
        if len(set(propagator.forces)) < len(propagator.forces):
            faults.append("parameters.propagator.forces: expected every force once")
        return faults
    if isinstance(parameters.satellites, ElementSetSatellites):
        return []
    return [
        f"parameters.propagator.kind: {propagator.kind} needs element sets, give satellites.elements; "
        "patterns and Keplerian elements need kind: scipy"
    ]


def _late_uplinks(parameters: ConstellationParameters, duration_s: float) -> list[str]:
    """Return a remark on uplinks whose time never comes: a run may be a shortened one."""
    late = [n for n, uplink in enumerate(parameters.uplinks) if uplink.at_s >= duration_s > 0.0]
    if not late:
        return []
    more = f", and {len(late) - 1} more" if len(late) > 1 else ""
    return [
        f"remark: parameters.uplinks[{late[0]}].at_s: {parameters.uplinks[late[0]].at_s:g} s is no time before the end"
        f" (time.duration_s, {duration_s:g} s): it never leaves{more}"
    ]


def _idle_coefficients(parameters: ConstellationParameters) -> list[str]:
    """Return remarks on ballistic coefficients that change nothing, as truth has no drag by them."""
    propagator = parameters.propagator
    if isinstance(propagator, CustomPropagator) or "drag" in propagator.forces:
        return []
    why = "drag is not among parameters.propagator.forces"
    if not propagator.PROPERTIES.knows_drag:
        others = _kinds(lambda each: each.knows_drag)
        why = f"{propagator.kind} knows no drag by it; take kind: {others}, with drag among its forces"
    remarks = []
    for number, vehicle in enumerate(parameters.vehicles):
        given = [
            name
            for name in ("ballistic_m2_kg", "ballistic_m2_kg_range")
            if getattr(vehicle, name) != getattr(DEFAULT, name)
        ]
        remarks += [
            f"remark: parameters.vehicles[{number}].{name}: changes nothing: {why}"
            for name in given[:1]
        ]
    return remarks


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


def _slow_tick_faults(
    parameters: ConstellationParameters, tick_hz: float, duration_s: float
) -> list[str]:
    """Return why an agent has no room for what comes between two ticks: it forgets truth in ticks alone; not judged without their rate."""
    if tick_hz <= 0.0:
        return []
    tick_s = min(1.0 / tick_hz, duration_s or math.inf)
    knot_s, buffer_s = parameters.segments.knot_s, parameters.segments.buffer_s
    between = f"between two ticks {tick_s:g} s apart (agents.tick_hz)"
    windows = tick_s / (buffer_s / 2.0)
    segments_max = SEGMENTS_MAX - SEGMENTS_AHEAD
    if windows > segments_max:
        return [
            f"parameters.segments.buffer_s: expected at least {2.0 * tick_s / segments_max:.4g} s, got {buffer_s:g} s: "
            f"an agent takes {windows:.0f} windows of half of it {between}, and holds {segments_max}; "
            "give a longer segments.buffer_s"
        ]
    knots = (windows + WINDOWS_AHEAD) * (buffer_s / 2.0 / knot_s + 1.0)
    if knots > KNOTS_HELD_MAX:
        return [
            f"parameters.segments.knot_s: expected at most {KNOTS_HELD_MAX} knots {between} and in the buffer, "
            f"got {knots:.0f} every {knot_s:g} s; give a longer segments.knot_s or a shorter segments.buffer_s"
        ]
    return []


def _attitude_faults(parameters: ConstellationParameters) -> list[str]:
    """Return rigid bodies that the propagator cannot do, or that turn too fast for the knots."""
    faults = []
    propagator = parameters.propagator
    by_engine = propagator.PROPERTIES.turns_bodies
    for number, vehicle in enumerate(parameters.vehicles):
        attitude, field = vehicle.attitude, f"parameters.vehicles[{number}].attitude"
        if attitude is None:
            continue
        if by_engine and attitude.wheels is not None:
            others = _kinds(lambda each: each.conserves_energy and not each.turns_bodies)
            faults.append(
                f"{field}.wheels: {propagator.kind} does rigid bodies without wheels only; drop them, which "
                f"makes torques exact and without limit, or take kind: {others}"
            )
        if attitude.magnetorquers is not None and not propagator.PROPERTIES.follows_dipoles:
            faults.append(
                f"{field}.magnetorquers: {propagator.kind} follows no magnetic dipole; drop them, or take "
                f"kind: {_kinds(lambda each: each.follows_dipoles)}"
            )
        turn_deg = math.hypot(*attitude.rates_deg_s) * parameters.segments.knot_s
        if turn_deg >= 180.0:
            faults.append(
                f"{field}.rates_deg_s: expected less than half a turn between knots, got "
                f"{turn_deg:g} deg; a shorter segments.knot_s follows faster ones"
            )
    return faults


def _kinds(are_meant: Callable[[PropagatorProperties], bool]) -> str:
    """Return the kinds of propagators with some properties, as in: scipy or numba."""
    return " or ".join(kind for kind, each in PROPAGATORS.items() if are_meant(each.PROPERTIES))


def _missing_libraries(parameters: ConstellationParameters) -> list[str]:
    wanted = {parameters.propagator.PROPERTIES: "parameters.propagator.kind"}
    if isinstance(parameters.satellites, ElementSetSatellites):
        wanted[Sgp4Propagator.PROPERTIES] = "parameters.satellites.elements"
    faults = []
    for properties, field in wanted.items():
        module = properties.library
        if module is not None and importlib.util.find_spec(module) is None:
            install = f"pip install 'cosmos-madns[{properties.extra}]'"
            faults.append(f"{field}: {module} is not installed here; install it with: {install}")
    return faults


def set_faults(
    parameters: ConstellationParameters, chosen: SatelliteSelection, duration_s: float
) -> list[str]:
    """
    Return the faults of the element sets that fly, each with file and line.

    Args:
        parameters: Of the scenario.
        chosen: Who flies, and from when on.
        duration_s: Of the run, simulated.
    """
    faults = _twice(chosen.element_sets)
    for element_set in chosen.element_sets:
        fault = _age_fault(element_set, chosen.epoch_utc) or _perigee_fault(element_set)
        fault = fault or _sgp4_fault(element_set, parameters, chosen.epoch_utc, duration_s)
        if fault:
            faults.append(f"{element_set.place}: {element_set.name}: {fault}")
    more = len(faults) - FAULTS_MAX
    return [
        *(f"{FIELD}: {fault}" for fault in faults[:FAULTS_MAX]),
        *([f"{FIELD}: and {more} more"] if more > 0 else []),
    ]


def _twice(element_sets: tuple[ElementSet, ...]) -> list[str]:
    """Return satellites of which two sets would fly: both in one place, or one out of date."""
    first: dict[str, ElementSet] = {}
    faults = []
    for element_set in element_sets:
        number = element_set.catalogue_number
        # Fragments of one body share a name; a set without a number has no other.
        what = f"catalogue number {number}" if number else f"name {element_set.name}"
        before = first.setdefault(what, element_set)
        if before is not element_set:
            faults.append(
                f"{element_set.place}: {element_set.name}: expected every satellite once, got {what} "
                f"as in {before.place}; choose by satellites.names"
            )
    return faults


def _age_fault(element_set: ElementSet, epoch_utc: datetime) -> str | None:
    if abs((epoch_utc - element_set.epoch_utc) / timedelta(days=1)) <= AGE_DAYS_MAX:
        return None
    return (
        f"expected an epoch within {AGE_DAYS_MAX:g} days of the start {epoch_utc:%Y-%m-%d}, got "
        f"{element_set.epoch_utc:%Y-%m-%d}; take sets of that time, or give parameters.epoch_utc"
    )


def _perigee_fault(element_set: ElementSet) -> str | None:
    perigee_km = element_set.perigee_km
    if perigee_km >= 0.0:
        return None
    return f"expected a perigee above the ground, got {perigee_km:.0f} km by its mean motion and eccentricity"


def _sgp4_fault(
    element_set: ElementSet,
    parameters: ConstellationParameters,
    epoch_utc: datetime,
    duration_s: float,
) -> str | None:
    try:
        # sgp4 may be missing, or not asked for.
        from madns_runtime.simulations.constellation.truth.propagators.sgp4_records import why_not
    except MissingExtraError:
        return None  # told by itself, with the command that installs it
    fault = why_not(element_set, epoch_utc)
    if fault is None and parameters.propagator.PROPERTIES.needs_element_sets:
        # Who falls meanwhile is lost at that time, as on_agent_loss says.
        knot_s = parameters.segments.knot_s
        fault = why_not(element_set, epoch_utc, duration_s, knot_s=knot_s)
    return fault
