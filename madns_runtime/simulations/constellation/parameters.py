"""
What a person may set in a scenario of the constellation.

Frozen dataclasses with bounds: the operator's side validates them, agents read them back with
`madns_runtime.config.from_mapping`, which tries the members of a union in order; each member
therefore has a field of its own that must be given. Only the standard library and annotated_types
are imported here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen

from madns_runtime.config import FORBID_EXTRA

SATELLITES_MAX = 5000
KNOTS_MAX = 100_000
"""Knots in one segment: more is a mistake, not a plan."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ElementSetSatellites:
    """Satellites from a file of element sets."""

    __pydantic_config__ = FORBID_EXTRA

    elements: Annotated[str, MinLen(1)]
    """File of TLE, or of OMM as CSV, JSON or XML; found from the scenario's folder."""
    names: tuple[str, ...] = ()
    """Names of the satellites to fly, in the agents' order; empty for the file's first ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkerSatellites:
    """Satellites in a Walker pattern of circular orbits."""

    __pydantic_config__ = FORBID_EXTRA

    walker: Annotated[str, MinLen(7)]
    """Inclination: satellites/planes/phasing, such as "86.4:66/6/2" (degrees for the first)."""
    altitude_km: Annotated[float, Gt(0), Le(400_000)]
    """Altitude above the gravity model's equatorial radius, km."""
    raan_spread_deg: Literal[180, 360] = 360
    """Over how much of the equator the nodes are spread: 360 a delta, 180 a star pattern."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeplerianOrbit:
    """One satellite's osculating elements at the epoch; give a_km or altitude_km."""

    __pydantic_config__ = FORBID_EXTRA

    name: Annotated[str, MinLen(1)]
    """Name of the satellite."""
    a_km: Annotated[float, Gt(6400), Le(1_000_000)] | None = None
    """Semi-major axis, km."""
    altitude_km: Annotated[float, Gt(0), Le(400_000)] | None = None
    """Semi-major axis minus the gravity model's equatorial radius, km."""
    e: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Eccentricity."""
    i_deg: Annotated[float, Ge(0), Le(180)] = 0.0
    """Inclination, deg."""
    raan_deg: float = 0.0
    """Right ascension of the ascending node, deg."""
    argp_deg: float = 0.0
    """Argument of perigee, deg."""
    mean_anomaly_deg: float = 0.0
    """Mean anomaly, deg."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeplerianSatellites:
    """Satellites from osculating elements written in the scenario."""

    __pydantic_config__ = FORBID_EXTRA

    keplerian: Annotated[tuple[KeplerianOrbit, ...], MinLen(1)]
    """One entry a satellite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScipyPropagator:
    """Numerical integration: DOP853 of scipy over all vehicles at once."""

    __pydantic_config__ = FORBID_EXTRA

    kind: Literal["scipy"]
    """scipy"""
    forces: tuple[Literal["two_body", "j2"], ...] = ("two_body", "j2")
    """Accelerations to sum; two_body must be among them."""
    rtol: Annotated[float, Ge(1e-13), Le(1e-6)] = 1e-12
    """Relative tolerance of a step, held for every vehicle by itself however many there are."""
    atol_m: Annotated[float, Ge(1e-9), Le(1)] = 1e-6
    """Absolute tolerance of a step in position, m; in velocity a thousandth of it a second."""
    step_s_max: Annotated[float, Gt(0)] = 30.0
    """Longest step, s: values between steps are interpolated, and long steps would spoil them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sgp4Propagator:
    """SGP4 from the element sets themselves (WGS-72, as the sets were fitted)."""

    __pydantic_config__ = FORBID_EXTRA

    kind: Literal["sgp4"]
    """sgp4"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentSettings:
    """How truth travels to the agents."""

    __pydantic_config__ = FORBID_EXTRA

    knot_s: Annotated[float, Ge(0.01), Le(60)] = 1.0
    """Time between knots, s; cubic Hermite between them errs 2e-8 m in LEO at 1 s, and as its fourth power."""
    buffer_s: Annotated[float, Ge(0.2), Le(3600)] = 20.0
    """Truth that an agent holds after a refill, s (T_bi); refilled when half is left, half at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordSettings:
    """What is recorded beyond every tick's state, and what is judged."""

    __pydantic_config__ = FORBID_EXTRA

    elements_hz: Annotated[float, Gt(0), Le(1000)] = 1.0
    """Rate at which agents record their osculating elements, Hz; at most the tick rate."""
    energy_drift_max: Annotated[float, Gt(0)] = 1e-9
    """Largest relative drift of a numerically propagated vehicle's specific orbital energy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstellationParameters:
    """The parameters section of a constellation scenario."""

    __pydantic_config__ = FORBID_EXTRA

    satellites: ElementSetSatellites | WalkerSatellites | KeplerianSatellites
    """Which satellites fly; the first agent flies the first, and so on."""
    epoch_utc: str | None = None
    """UTC of simulated time zero, such as 2017-03-07T12:00:00Z; none for the latest epoch of the sets flown."""
    frame: Literal["TEME"] = "TEME"
    """Frame of every position and velocity: true equator, mean equinox of date."""
    gravity: Literal["EGM-96", "WGS-84", "WGS-72"] = "EGM-96"
    """Gravity constants of numerical propagation and of the recorded elements."""
    propagator: ScipyPropagator | Sgp4Propagator = field(
        default_factory=lambda: ScipyPropagator(kind="scipy")
    )
    """Who computes truth."""
    segments: SegmentSettings = field(default_factory=SegmentSettings)
    """How truth travels."""
    record: RecordSettings = field(default_factory=RecordSettings)
    """What is recorded."""
