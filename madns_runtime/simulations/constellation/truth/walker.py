"""Walker patterns i: t/p/f of circular orbits. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.elements import Elements

_NOTATION = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?)\s*:\s*([0-9]+)\s*/\s*([0-9]+)\s*/\s*([0-9]+)\s*")


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
            f'expected "inclination: satellites/planes/phasing" such as "86.4:66/6/2", got {text!r}'
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
