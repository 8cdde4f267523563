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
from madns_runtime.simulations.constellation.equipment import Vehicle

Force = Literal["two_body", "j2", "j3", "j4", "drag"]
Setting = bool | int | float | str | list[float] | list[str]
"""A value of one's own that a scenario hands to code of one's own."""
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
    forces: tuple[Force, ...] = ("two_body", "j2")
    """Accelerations to sum; two_body must be among them."""
    rtol: Annotated[float, Ge(1e-13), Le(1e-6)] = 1e-12
    """Relative tolerance of a step, held for every vehicle by itself however many there are."""
    atol_m: Annotated[float, Ge(1e-9), Le(1)] = 1e-6
    """Absolute tolerance of a step in position, m; in velocity a thousandth of it a second."""
    step_s_max: Annotated[float, Ge(0.01)] = 30.0
    """Longest step, s: values between steps are interpolated, and long steps would spoil them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NumbaPropagator:
    """Numerical integration compiled to machine code, each vehicle at its own steps: extra `fast`."""

    __pydantic_config__ = FORBID_EXTRA

    kind: Literal["numba"]
    """numba"""
    forces: tuple[Force, ...] = ("two_body", "j2")
    """Accelerations to sum; two_body must be among them."""
    rtol: Annotated[float, Ge(1e-13), Le(1e-6)] = 1e-12
    """Relative tolerance of a step."""
    atol_m: Annotated[float, Ge(1e-9), Le(1)] = 1e-6
    """Absolute tolerance of a step in position, m; in velocity a thousandth of it a second."""
    step_s_max: Annotated[float, Ge(0.01)] = 30.0
    """Longest step, s."""
    threads: Annotated[int, Ge(1), Le(256)] = 1
    """Threads that share the vehicles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sgp4Propagator:
    """SGP4 from the element sets themselves (WGS-72, as the sets were fitted)."""

    __pydantic_config__ = FORBID_EXTRA

    kind: Literal["sgp4"]
    """sgp4"""


@dataclass(frozen=True, slots=True, kw_only=True)
class BasiliskPropagator:
    """The Basilisk framework's spacecraft dynamics at a fixed step: extra `basilisk`."""

    __pydantic_config__ = FORBID_EXTRA

    kind: Literal["basilisk"]
    """basilisk"""
    forces: tuple[Literal["two_body", "j2"], ...] = ("two_body", "j2")
    """Accelerations to sum; two_body must be among them."""
    step_s: Annotated[float, Ge(1e-3), Le(60)] = 0.1
    """Integration step (RK4), s."""
    simulations: Literal["one", "per_vehicle"] = "one"
    """All vehicles in one simulation with one clock, or one simulation for each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CustomPropagator:
    """A propagator of one's own: a class with `propagate`, see `truth.propagation.Propagator`."""

    __pydantic_config__ = FORBID_EXTRA

    kind: Literal["custom"]
    """custom"""
    implementation: Annotated[str, MinLen(3)]
    """module:Class, or file.py:Class beside the scenario."""
    can_maneuver: bool = True
    """Whether it propagates from any state, as a maneuver needs."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """For the class to read: PropagationParameters.settings.settings."""


AnyPropagator = (
    ScipyPropagator | NumbaPropagator | Sgp4Propagator | BasiliskPropagator | CustomPropagator
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Maneuvers:
    """How commands that change truth are treated."""

    __pydantic_config__ = FORBID_EXTRA

    late: Literal["postpone", "refuse"] = "postpone"
    """What becomes of a command that cannot be in truth by its time: executed at the first feasible time,
    or not at all."""
    propagation_s: Annotated[float, Gt(0), Le(60)] = 0.02
    """T_p: time allowed for propagating one vehicle anew; more is counted against the inequality."""
    network_s: Annotated[float, Ge(0), Le(60)] = 0.02
    """T_n: time allowed for one way of a message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Crosslinks:
    """Radio between vehicles: the host is the medium."""

    __pydantic_config__ = FORBID_EXTRA

    range_km_max: Annotated[float, Gt(0)] = 5000.0
    """Longest link, km."""
    atmosphere_km: Annotated[float, Ge(0)] = 100.0
    """Height below which the Earth's atmosphere blocks a link, km."""
    rate_bit_s: Annotated[float, Ge(1)] = 1e6
    """Rate of every transmitter; its messages wait for each other, bit/s."""
    processing_s: Annotated[float, Ge(0)] = 0.0
    """Added to light time and transmission, s."""
    loss: Annotated[float, Ge(0), Le(1)] = 0.0
    """Share of messages lost on the way."""
    queue_max: Annotated[int, Ge(1)] = 256
    """Messages that may wait at one transmitter; further ones are refused and counted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundStation:
    """A place on the ground that vehicles may speak to while it sees them."""

    __pydantic_config__ = FORBID_EXTRA

    name: Annotated[str, MinLen(1)]
    """Messages to it go to ground:NAME, messages to any station to ground."""
    latitude_deg: Annotated[float, Ge(-90), Le(90)]
    """Geodetic latitude on WGS-84, deg."""
    longitude_deg: Annotated[float, Ge(-180), Le(360)]
    """East longitude, deg."""
    altitude_m: Annotated[float, Ge(-500), Le(9000)] = 0.0
    """Height above the ellipsoid, m."""
    elevation_deg_min: Annotated[float, Ge(0), Lt(90)] = 10.0
    """Elevation mask, deg."""
    rate_bit_s: Annotated[float, Ge(1)] = 1e6
    """Rate of each way of a contact, bit/s."""
    loss: Annotated[float, Ge(0), Le(1)] = 0.0
    """Share of messages of either way that are lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Uplink:
    """A message that the ground has for a vehicle; it leaves in the first pass from its time on."""

    __pydantic_config__ = FORBID_EXTRA

    at_s: Annotated[float, Ge(0)]
    """Simulated time from which it waits, s."""
    to: Annotated[str, MinLen(1)]
    """Agent or satellite."""
    text: str
    """What flight software receives."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSoftware:
    """Flight software in Python: one class in one file."""

    __pydantic_config__ = FORBID_EXTRA

    software: Annotated[str, MinLen(3)]
    """guidance.py:Guidance beside the scenario, or module:Class."""
    agents: Annotated[tuple[str, ...], MinLen(1)] = ("*",)
    """Globs of agents' or satellites' names that fly it; the others are not commanded."""
    input: Literal["measurements", "truth"] = "measurements"
    """What it is given every tick."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """For the class to read: context.settings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightProcess:
    """Flight software in any language: a program that speaks JSON lines on stdin and stdout."""

    __pydantic_config__ = FORBID_EXTRA

    command: Annotated[tuple[str, ...], MinLen(1)]
    """The program and its arguments; a relative path is found from the scenario's folder."""
    agents: Annotated[tuple[str, ...], MinLen(1)] = ("*",)
    """Globs of agents' or satellites' names that fly it."""
    input: Literal["measurements", "truth"] = "measurements"
    """What it is given every tick."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """In the first line that it reads."""
    answer_s: Annotated[float, Gt(0)] = 1.0
    """Time for the answer to a tick; in real time a later one is counted as late and taken when it comes."""


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
    """What is recorded and what is judged."""

    __pydantic_config__ = FORBID_EXTRA

    state_hz: Annotated[float, Gt(0), Le(10_000)] | None = None
    """Rate at which agents record their state, Hz; none for every tick."""
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
    propagator: AnyPropagator = field(default_factory=lambda: ScipyPropagator(kind="scipy"))
    """Who computes truth."""
    vehicles: tuple[Vehicle, ...] = (Vehicle(),)
    """What the vehicles are like; the first entry that fits a vehicle describes it."""
    maneuvers: Maneuvers = field(default_factory=Maneuvers)
    """How commands that change truth are treated."""
    flight: str | FlightSoftware | FlightProcess | None = None
    """Flight software of the agents: file.py:Class, or with settings; none for vehicles that only coast."""
    crosslinks: Crosslinks | None = None
    """Radio between vehicles; none for no radio."""
    stations: tuple[GroundStation, ...] = ()
    """Ground stations."""
    uplinks: tuple[Uplink, ...] = ()
    """What the ground has to say."""
    segments: SegmentSettings = field(default_factory=SegmentSettings)
    """How truth travels."""
    record: RecordSettings = field(default_factory=RecordSettings)
    """What is recorded."""
