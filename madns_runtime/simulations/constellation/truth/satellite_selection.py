"""
Selection of the satellites that fly: from a scenario's parameters to satellites and their epoch, not yet states.

Needs neither numpy nor sgp4, so that `cosmos validate` finds every fault that a person can make at once.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path

from madns_runtime.errors import ConfigurationError
from madns_runtime.plain_values import LINE_CHARACTERS_MAX, is_line, shown
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.elements import Elements
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    ElementSetSatellites,
    KeplerianOrbit,
    KeplerianSatellites,
    WalkerSatellites,
)
from madns_runtime.simulations.constellation.truth.element_set import (
    FIRST_YEAR,
    LAST_YEAR,
    ElementSet,
)
from madns_runtime.simulations.constellation.truth.element_sets import (
    FAULTS_MAX,
    read_element_sets,
)

EPOCH_WITHOUT_SETS = datetime(2000, 1, 1, 12, tzinfo=UTC)
"""Simulated time zero of patterns and elements for which the scenario names none: J2000, read as UTC."""

_NOTATION = re.compile(
    r"\s*([0-9]{1,3}(?:\.[0-9]{0,12})?)\s*:\s*([0-9]{1,9})\s*/\s*([0-9]{1,9})\s*/\s*([0-9]{1,9})\s*"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SatelliteSelection:
    """Satellites chosen, one per agent, not yet propagated to the epoch; one of sets and orbits is filled."""

    names: tuple[str, ...]
    epoch_utc: datetime
    element_sets: tuple[ElementSet, ...] = ()
    orbits: tuple[Elements, ...] = ()


def choose(
    parameters: ConstellationParameters, count: int, base_directory: Path
) -> SatelliteSelection:
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
            f"parameters.epoch_utc: expected such as 2017-03-07T12:00:00Z, got {text[:80]!r}"
        )
    if not FIRST_YEAR <= moment.year < LAST_YEAR:
        raise ConfigurationError(
            f"parameters.epoch_utc: expected a year from {FIRST_YEAR} to {LAST_YEAR - 1}, got {text!r}"
        )
    return moment.astimezone(UTC)


def _choose_satellites(
    parameters: ConstellationParameters, count: int, base_directory: Path
) -> SatelliteSelection:
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
    return SatelliteSelection(
        names=tuple(name for name, _ in orbits[:count]),
        epoch_utc=EPOCH_WITHOUT_SETS,
        orbits=tuple(elements for _, elements in orbits[:count]),
    )


def _choose_sets(
    satellites: ElementSetSatellites, count: int, base_directory: Path
) -> SatelliteSelection:
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
    faults = [
        f"parameters.satellites.elements: {one.place}: {fault}"
        for one in chosen
        if (fault := _name_fault(one.name))
    ]
    if faults:
        more = len(faults) - FAULTS_MAX
        rest = [f"parameters.satellites.elements: and {more} more"] if more > 0 else []
        raise ConfigurationError("\n".join(faults[:FAULTS_MAX] + rest))
    return SatelliteSelection(
        names=tuple(s.name for s in chosen),
        epoch_utc=_whole_second(max(s.epoch_utc for s in chosen)),
        element_sets=chosen,
    )


def _name_fault(name: str) -> str | None:
    """Return what is wrong with a satellite's name, which stands in records, tables and messages."""
    if name and is_line(name):
        return None
    return (
        f"expected a name of at most {LINE_CHARACTERS_MAX} printable characters, got {shown(name)}"
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
    return walker_orbits(
        pattern,
        a_m=GRAVITY_MODELS[parameters.gravity].radius_m + satellites.altitude_km * 1000.0,
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
        if fault := _name_fault(orbit.name):
            faults.append(f"{where}.name: {fault}")
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


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkerPattern:
    """Inclination and the three whole numbers of a Walker pattern."""

    inclination_deg: float
    satellites: int
    planes: int
    phasing: int


def parse_walker(text: str) -> WalkerPattern:
    """
    Return the pattern written as "i: t/p/f".

    Raises:
        ConfigurationError: It is not written so, or its numbers make no pattern.
    """
    match = _NOTATION.fullmatch(text)
    if match is None:
        raise ConfigurationError(
            f'expected "inclination: satellites/planes/phasing" such as "86.4:66/6/2", got {text[:80]!r}'
        )
    inclination, (t, p, f) = float(match[1]), map(int, match.groups()[1:])
    if inclination > 180.0:
        raise ConfigurationError(f"expected an inclination of 0 to 180 deg, got {inclination:g}")
    if p < 1 or t < p or t % p:
        raise ConfigurationError(f"expected satellites that fill the planes evenly, got {t}/{p}")
    if f >= p:
        raise ConfigurationError(f"expected a phasing below the number of planes {p}, got {f}")
    return WalkerPattern(inclination_deg=inclination, satellites=t, planes=p, phasing=f)


def walker_orbits(
    pattern: WalkerPattern, *, a_m: float, raan_spread_deg: float
) -> Iterator[tuple[str, Elements]]:
    """
    Yield a name such as P2S05 and the elements of every satellite, plane by plane.

    Args:
        pattern: The pattern.
        a_m: Radius of the circular orbits, m.
        raan_spread_deg: Over how much of the equator the nodes are spread: 360 delta, 180 star.

    Source: Walker, Satellite constellations, JBIS 37 (1984): neighbours in a plane are 360/s apart,
    and satellites of neighbouring planes are shifted by 360 f / t.
    """
    per_plane = pattern.satellites // pattern.planes
    width = len(str(per_plane))
    for plane in range(pattern.planes):
        raan = math.radians(raan_spread_deg * plane / pattern.planes)
        for slot in range(per_plane):
            turns = slot / per_plane + pattern.phasing * plane / pattern.satellites
            elements = Elements(
                a_m=a_m,
                e=0.0,
                i_rad=math.radians(pattern.inclination_deg),
                raan_rad=raan,
                argp_rad=0.0,
                mean_anomaly_rad=math.tau * (turns % 1.0),
            )
            yield f"P{plane + 1}S{slot + 1:0{width}d}", elements
