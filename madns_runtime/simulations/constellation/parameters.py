"""
Parameters of the constellation, as a person sets them in a scenario.

Frozen dataclasses with bounds: the operator's side validates them, agents read them back with
`madns_runtime.config.from_mapping`, which tries the members of a union in order; each member
therefore has a field of its own that must be given. Only the standard library and annotated_types
are imported here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, get_args, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, MinLen

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.flight_settings import (
    FlightAttached,
    FlightClass,
    FlightProcess,
    Setting,
)

Force = Literal["two_body", "j2", "j3", "j4", "drag"]
KNOTS_MAX = 100_000
"""Knots in one segment: more is a mistake, not a plan."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ElementSetSatellites:
    """Satellites from a file of element sets."""

    elements: Annotated[str, MinLen(1)]
    """File of TLE, or of OMM as CSV, JSON or XML; found from the scenario's folder."""
    names: tuple[str, ...] = ()
    """Names of the satellites to fly, in the agents' order; empty for the file's first ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkerSatellites:
    """Satellites in a Walker pattern of circular orbits."""

    walker: Annotated[str, MinLen(7)]
    """Inclination: satellites/planes/phasing, such as "86.4:66/6/2" (degrees for the first)."""
    altitude_km: Annotated[float, Gt(0), Le(400_000)]
    """Altitude above the gravity model's equatorial radius, km."""
    raan_spread_deg: Literal[180, 360] = 360
    """Over how much of the equator the nodes are spread: 360 a delta, 180 a star pattern."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeplerianOrbit:
    """One satellite's osculating elements at the epoch; give a_km or altitude_km."""

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
    raan_deg: Annotated[float, Ge(-360), Le(360)] = 0.0
    """Right ascension of the ascending node, deg."""
    argp_deg: Annotated[float, Ge(-360), Le(360)] = 0.0
    """Argument of perigee, deg."""
    mean_anomaly_deg: Annotated[float, Ge(-360), Le(360)] = 0.0
    """Mean anomaly, deg."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeplerianSatellites:
    """Satellites from osculating elements written in the scenario."""

    keplerian: Annotated[tuple[KeplerianOrbit, ...], MinLen(1)]
    """One entry per satellite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PropagatorProperties:
    """Properties of a propagator whatever its settings, known without its library."""

    engine: str
    """module:Class below `truth.propagators`; see `truth.propagation.Propagator`."""
    library: str | None = None
    """Module that it needs."""
    extra: str = "host"
    """Extra of the distribution that brings the library."""
    is_independent: bool = False
    """Whether a vehicle's neighbours in a call change none of its digits."""
    conserves_energy: bool = False
    """Whether it integrates known forces, so that without drag and thrust energy stays."""
    needs_element_sets: bool = False
    """Whether it starts from element sets, not from states."""
    turns_bodies: bool = False
    """Whether it integrates attitude itself, of bodies without wheels: `truth.propagators.attitude` does else."""
    follows_dipoles: bool = False
    """Whether bodies turn by their magnetorquers."""
    knows_drag: bool = False
    """Whether drag by a vehicle's ballistic coefficient may be among its forces."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScipyPropagator:
    """Numerical integration: DOP853 of scipy over all vehicles at once."""

    PROPERTIES: ClassVar = PropagatorProperties(
        engine="scipy_propagator:ScipyDop853",
        library="scipy",
        conserves_energy=True,
        follows_dipoles=True,
        knows_drag=True,
    )
    can_maneuver: ClassVar[bool] = True

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

    PROPERTIES: ClassVar = PropagatorProperties(
        engine="numba_propagator:NumbaDop853",
        library="numba",
        extra="fast",
        is_independent=True,
        conserves_energy=True,
        follows_dipoles=True,
        knows_drag=True,
    )
    can_maneuver: ClassVar[bool] = True

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

    PROPERTIES: ClassVar = PropagatorProperties(
        engine="sgp4_propagator:Sgp4", library="sgp4", is_independent=True, needs_element_sets=True
    )
    can_maneuver: ClassVar[bool] = False
    forces: ClassVar[tuple[Force, ...]] = ("two_body", "j2")
    """Forces that it is judged by."""

    kind: Literal["sgp4"]
    """sgp4"""


@dataclass(frozen=True, slots=True, kw_only=True)
class BasiliskPropagator:
    """The Basilisk framework's spacecraft dynamics at a fixed step: extra `basilisk`."""

    PROPERTIES: ClassVar = PropagatorProperties(
        engine="basilisk_propagator:Basilisk",
        library="Basilisk",
        extra="basilisk",
        is_independent=True,
        conserves_energy=True,
        turns_bodies=True,
    )
    can_maneuver: ClassVar[bool] = True

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

    PROPERTIES: ClassVar = PropagatorProperties(engine="custom_propagator:Custom")
    forces: ClassVar[tuple[Force, ...]] = ("two_body", "j2")
    """Forces that it is judged by."""

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
"""All that there are: another one is a class of settings with its properties, and its engine's module."""
PROPAGATORS: dict[str, type[AnyPropagator]] = {
    get_args(get_type_hints(settings)["kind"])[0]: settings for settings in get_args(AnyPropagator)
}
"""The kind in a scenario -> its settings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Maneuvers:
    """Treatment of commands that change truth."""

    late: Literal["postpone", "refuse"] = "postpone"
    """Fate of a command that cannot be in truth by its time: executed at the first feasible time,
    or not at all."""
    duration_s_max: Annotated[float, Gt(0)] = 60.0
    """Longest torque or dipole, s; longer ones are refused. So long at most acts what software commanded that is silent
    since, or whose board is lost."""
    propagation_s: Annotated[float, Gt(0), Le(60)] = 0.02
    """T_p: time allowed for propagating one vehicle anew; more is counted against the inequality."""
    network_s: Annotated[float, Ge(0), Le(60)] = 0.02
    """T_n: time allowed for one way of a message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Crosslinks:
    """Radio between vehicles: the host is the medium."""

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

    at_s: Annotated[float, Ge(0)]
    """Simulated time from which it waits, s."""
    to: Annotated[str, MinLen(1)]
    """Agent or satellite."""
    text: str
    """Text that flight software receives."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentSettings:
    """Way of truth to the agents."""

    knot_s: Annotated[float, Ge(0.01), Le(60)] = 1.0
    """Time between knots, s; cubic Hermite between them errs 2e-8 m in LEO at 1 s, and as its fourth power."""
    buffer_s: Annotated[float, Ge(0.2), Le(3600)] = 20.0
    """Truth that an agent holds after a refill, s (T_bi); refilled when half is left, half at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordSettings:
    """Selection of what is recorded and judged."""

    truth: bool = True
    """Whether the host records the truth that it sends, to the bit: `cosmos tabulate` makes a table of it."""

    state_hz: Annotated[float, Gt(0), Le(10_000)] | None = None
    """Rate at which agents record their state, Hz, at most the tick rate, each in the tick nearest to its time; none for
    every tick."""
    elements_hz: Annotated[float, Gt(0), Le(1000)] = 1.0
    """Rate at which agents record their osculating elements, Hz, each in the tick nearest to its time; at most the tick rate."""
    slots_hz: Annotated[float, Gt(0), Le(1)] | None = None
    """Rate at which the host records slot errors by truth, Hz, of flight software whose settings say slots: even; none
    for no record."""
    attitude_error_rad_max: Annotated[float, Gt(0)] = 1e-4
    """Most by which a rigid body's attitude between knots may be off, rad; a shorter segments.knot_s makes it less."""
    energy_drift_max: Annotated[float, Gt(0)] = 1e-9
    """Largest relative drift of a numerically propagated vehicle's specific orbital energy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstellationParameters:
    """The parameters section of a constellation scenario."""

    satellites: ElementSetSatellites | WalkerSatellites | KeplerianSatellites
    """Satellites that fly; the first agent flies the first, and so on."""
    epoch_utc: str | None = None
    """UTC of simulated time zero, such as 2017-03-07T12:00:00Z; none for the latest epoch of the sets flown."""
    frame: Literal["TEME"] = "TEME"
    """Frame of every position and velocity: true equator, mean equinox of date."""
    gravity: Literal["EGM-96", "WGS-84", "WGS-72"] = "EGM-96"
    """Gravity constants of numerical propagation and of the recorded elements."""
    propagator: AnyPropagator = field(default_factory=lambda: ScipyPropagator(kind="scipy"))
    """Propagator of truth."""
    vehicles: tuple[Vehicle, ...] = (Vehicle(),)
    """Descriptions of the vehicles; the first entry that fits a vehicle describes it."""
    maneuvers: Maneuvers = field(default_factory=Maneuvers)
    """Treatment of commands that change truth."""
    flight: (
        str
        | FlightClass
        | FlightProcess
        | FlightAttached
        | tuple[str | FlightClass | FlightProcess | FlightAttached, ...]
        | None
    ) = None
    """Flight software of the agents: file.py:Class, or with settings, or a list of rules of which the first that
    fits a vehicle holds; none for vehicles that only coast."""
    crosslinks: Crosslinks | None = None
    """Radio between vehicles; none for no radio."""
    stations: tuple[GroundStation, ...] = ()
    """Ground stations."""
    uplinks: tuple[Uplink, ...] = ()
    """Messages from the ground."""
    segments: SegmentSettings = field(default_factory=SegmentSettings)
    """Way of truth to the agents."""
    record: RecordSettings = field(default_factory=RecordSettings)
    """Selection of what is recorded."""
    recorded_agents: Annotated[str, MinLen(1)] | None = None
    """Folder of a recorded run's agents, such as runs/0007-hwil/agents: results of commands and refusals of messages
    are told in the ticks in which they were told then, not as soon as they come, in lockstep; `cosmos rerun` writes it."""
