"""
Who flies: from a scenario's parameters to the chosen satellites and their epoch, not yet states.

Needs neither numpy nor sgp4, so that `cosmos validate` finds every fault that a person can make at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.elements import Elements
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    ElementSetSatellites,
    KeplerianOrbit,
    KeplerianSatellites,
    WalkerSatellites,
)
from madns_runtime.simulations.constellation.truth.element_sets import (
    ElementSet,
    read_element_sets,
)
from madns_runtime.simulations.constellation.truth.walker import parse_walker, walker_orbits

EPOCH_WITHOUT_SETS = datetime(2000, 1, 1, 12, tzinfo=UTC)
"""Simulated time zero of patterns and elements for which the scenario names none: J2000, read as UTC."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Satellites chosen, one an agent, not yet propagated to the epoch; one of sets and orbits is filled."""

    names: tuple[str, ...]
    epoch_utc: datetime
    element_sets: tuple[ElementSet, ...] = ()
    orbits: tuple[Elements, ...] = ()


def choose(parameters: ConstellationParameters, count: int, base_directory: Path) -> Choice:
    """
    Return the *count* satellites that fly.

    Args:
        parameters: Of the scenario.
        count: Number of agents.
        base_directory: Folder that files are found from.

    Raises:
        ConfigurationError: One line a fault, each starting with the dotted parameter name.
    """
    faults = []
    epoch = None
    try:
        epoch = parse_epoch(parameters.epoch_utc)
    except ConfigurationError as error:
        faults.append(str(error))
    try:
        chosen = _choose_satellites(parameters, count, base_directory)
    except ConfigurationError as error:
        faults.append(str(error))
    if faults:
        raise ConfigurationError("\n".join(faults))
    return chosen if epoch is None else replace(chosen, epoch_utc=epoch)


def parse_epoch(text: str | None) -> datetime | None:
    """
    Return the moment that *text* names, None for None.

    Raises:
        ConfigurationError: It is not an ISO 8601 date and time in UTC.
    """
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.utcoffset() != timedelta(0):
        raise ConfigurationError(
            f"parameters.epoch_utc: expected such as 2017-03-07T12:00:00Z, got {text!r}"
        )
    return moment.astimezone(UTC)


def _choose_satellites(
    parameters: ConstellationParameters, count: int, base_directory: Path
) -> Choice:
    """Return the satellites with the epoch that stands if the scenario names none."""
    satellites = parameters.satellites
    if isinstance(satellites, ElementSetSatellites):
        return _choose_sets(satellites, count, base_directory)
    if isinstance(satellites, WalkerSatellites):
        # No more than fly: a pattern may have millions.
        orbits = tuple(islice(_walker_orbits(satellites, parameters), count))
        field = "walker"
    else:
        orbits, field = _keplerian_orbits(satellites, parameters), "keplerian"
    if len(orbits) < count:
        raise _too_few(field, len(orbits), count)
    return Choice(
        names=tuple(name for name, _ in orbits[:count]),
        epoch_utc=EPOCH_WITHOUT_SETS,
        orbits=tuple(elements for _, elements in orbits[:count]),
    )


def _choose_sets(satellites: ElementSetSatellites, count: int, base_directory: Path) -> Choice:
    try:
        sets = read_element_sets(base_directory / satellites.elements)
    except ConfigurationError as error:
        prefix = "parameters.satellites.elements: "
        raise ConfigurationError(
            "\n".join(prefix + line for line in str(error).splitlines())
        ) from error
    if satellites.names:
        sets = _named(sets, satellites.names)
    if len(sets) < count:
        raise _too_few("names" if satellites.names else "elements", len(sets), count)
    chosen = sets[:count]
    return Choice(
        names=tuple(s.name for s in chosen),
        epoch_utc=_whole_second(max(s.epoch_utc for s in chosen)),
        element_sets=chosen,
    )


def _named(sets: tuple[ElementSet, ...], names: tuple[str, ...]) -> tuple[ElementSet, ...]:
    by_name: dict[str, list[ElementSet]] = {}
    for element_set in sets:
        by_name.setdefault(element_set.name, []).append(element_set)
    faults = []
    for name in names:
        found = len(by_name.get(name, ()))
        if found == 0:
            close = [known for known in by_name if known.casefold() == name.casefold()]
            known = ", ".join(close or list(by_name)[:10])
            faults.append(
                f"parameters.satellites.names: {name!r} is not in the file; it has {known}"
            )
        elif found > 1:
            faults.append(f"parameters.satellites.names: {name!r} is {found} times in the file")
    if len(set(names)) < len(names):
        faults.append("parameters.satellites.names: expected every name once")
    if faults:
        raise ConfigurationError("\n".join(faults))
    return tuple(by_name[name][0] for name in names)


def _whole_second(moment: datetime) -> datetime:
    """Return the next whole second: a round simulated time zero reads better in every record."""
    below = moment.replace(microsecond=0)
    return below if below == moment else below + timedelta(seconds=1)


def _walker_orbits(
    satellites: WalkerSatellites, parameters: ConstellationParameters
) -> Iterator[tuple[str, Elements]]:
    try:
        pattern = parse_walker(satellites.walker)
    except ConfigurationError as error:
        raise ConfigurationError(f"parameters.satellites.walker: {error}") from error
    radius_m = GRAVITY_MODELS[parameters.gravity].radius_m
    return walker_orbits(
        pattern,
        a_m=radius_m + satellites.altitude_km * 1000.0,
        raan_spread_deg=float(satellites.raan_spread_deg),
    )


def _keplerian_orbits(
    satellites: KeplerianSatellites, parameters: ConstellationParameters
) -> tuple[tuple[str, Elements], ...]:
    radius_m = GRAVITY_MODELS[parameters.gravity].radius_m
    faults: list[str] = []
    orbits = []
    for index, orbit in enumerate(satellites.keplerian):
        where = f"parameters.satellites.keplerian[{index}]"
        if (orbit.a_km is None) == (orbit.altitude_km is None):
            faults.append(f"{where}: expected either a_km or altitude_km")
            continue
        elements = _elements(orbit, radius_m)
        if elements.a_m * (1.0 - elements.e) < radius_m:
            perigee_km = (elements.a_m * (1.0 - elements.e) - radius_m) / 1000.0
            faults.append(f"{where}: perigee lies {-perigee_km:.1f} km below the Earth's surface")
        orbits.append((orbit.name, elements))
    names = [orbit.name for orbit in satellites.keplerian]
    if len(set(names)) < len(names):
        faults.append("parameters.satellites.keplerian: expected every name once")
    if faults:
        raise ConfigurationError("\n".join(faults))
    return tuple(orbits)


def _elements(orbit: KeplerianOrbit, radius_m: float) -> Elements:
    a_m = orbit.a_km * 1000.0 if orbit.a_km is not None else radius_m
    if orbit.altitude_km is not None:
        a_m = radius_m + orbit.altitude_km * 1000.0
    return Elements(
        a_m=a_m,
        e=orbit.e,
        i_rad=math.radians(orbit.i_deg),
        raan_rad=math.radians(orbit.raan_deg),
        argp_rad=math.radians(orbit.argp_deg),
        mean_anomaly_rad=math.radians(orbit.mean_anomaly_deg),
    )


def _too_few(field: str, found: int, wanted: int) -> ConfigurationError:
    return ConfigurationError(
        f"parameters.satellites.{field}: expected a satellite for each of {wanted} agents, got {found}"
    )
