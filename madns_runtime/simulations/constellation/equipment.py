"""
Equipment and body of a vehicle, as a person writes them in a scenario: thruster, wheels, body, sensors.

As in `parameters`: frozen dataclasses with bounds, the standard library and annotated_types alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen


@dataclass(frozen=True, slots=True, kw_only=True)
class Thruster:
    """Errors and limits that turn a commanded delta-v into a real one."""

    isp_s: Annotated[float, Gt(0), Le(100_000)]
    """Specific impulse, s."""
    propellant_kg: Annotated[float, Ge(0)]
    """Propellant at the epoch, kg; part of the vehicle's mass."""
    thrust_n: Annotated[float, Gt(0)] | None = None
    """Thrust, N: delta-v is a finite burn around its time; none for an impulse."""
    magnitude_error: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Standard deviation of the delta-v's magnitude, as a share of it."""
    direction_error_deg: Annotated[float, Ge(0), Le(20)] = 0.0
    """Standard deviation of the delta-v's direction about each of two axes, deg."""
    minimum_impulse_n_s: Annotated[float, Ge(0)] = 0.0
    """A smaller impulse is not executed, N s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReactionWheels:
    """Errors and limits that turn a commanded torque into a real one."""

    torque_n_m_max: Annotated[float, Gt(0)]
    """Largest torque about each body axis, N m."""
    momentum_n_m_s_max: Annotated[float, Gt(0)]
    """Momentum about each body axis at which the wheels are saturated, N m s."""
    torque_error: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Standard deviation of the torque, as a share of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """A rigid body: quaternion (scalar last, inertial to body) and body rates are propagated as well."""

    inertia_kg_m2: tuple[Annotated[float, Gt(0)], Annotated[float, Gt(0)], Annotated[float, Gt(0)]]
    """Principal moments of inertia about body x, y, z, kg m^2."""
    initial: Literal["nadir", "inertial"] = "nadir"
    """nadir: body z to the Earth, y against the orbit normal, turning with the orbit; inertial: body axes
    on the frame's, at rest."""
    rates_deg_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to the body rates at the epoch, deg/s."""
    has_gravity_gradient: bool = True
    """Whether the Earth's gravity turns it."""
    wheels: ReactionWheels | None = None
    """Actuators of commanded torques; none for exact torques without limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Errors that every sensor may have. Units of the noise are those of the sensor's values."""

    rate_hz: Annotated[float, Gt(0)] = 1.0
    """Measurements per second; at most one per tick."""
    noise: Annotated[float, Ge(0)] = 0.0
    """Standard deviation of white noise on each value."""
    bias: Annotated[float, Ge(0)] = 0.0
    """Standard deviation of a constant error of each value."""
    bias_walk: Annotated[float, Ge(0)] = 0.0
    """Standard deviation of the bias's walk over one square root of a second."""
    latency_s: Annotated[float, Ge(0)] = 0.0
    """From the moment measured until flight software has it, s."""
    dropout: Annotated[float, Ge(0), Le(1)] = 0.0
    """Share of measurements that never come."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gnss(SensorNoise):
    """Position (m) and velocity (m/s) in the run's frame; `noise` and biases are those of position."""

    velocity_noise_m_s: Annotated[float, Ge(0)] = 0.0
    """Standard deviation of white noise on each component of velocity, m/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Magnetometer(SensorNoise):
    """Magnetic field in body axes, T; in the run's frame for a vehicle without attitude."""

    field: Literal["dipole", "igrf"] = "dipole"
    """dipole: tilted dipole; igrf: the extra `igrf`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """Sensors of a vehicle; absent ones measure nothing."""

    gnss: Gnss | None = None
    """Position and velocity."""
    gyro: SensorNoise | None = None
    """Body rates, rad/s."""
    accelerometer: SensorNoise | None = None
    """Specific force, mean since the measurement before, in body axes, m/s^2."""
    magnetometer: Magnetometer | None = None
    """Magnetic field."""
    star_tracker: SensorNoise | None = None
    """Quaternion, scalar last, inertial to body; noise in rad about each body axis."""
    sun_sensor: SensorNoise | None = None
    """Unit vector to the Sun in body axes; nothing in eclipse; noise in rad."""
    clock: SensorNoise | None = None
    """Time since the epoch, s."""


BallisticCoefficient = Annotated[float, Ge(0), Le(100)]
"""m^2/kg, from nothing to a foil of 20 g/m^2; of more no integrator could follow the end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """Description of some of the vehicles."""

    agents: Annotated[tuple[str, ...], MinLen(1)] = ("*",)
    """Globs of agents' or satellites' names; a vehicle is described by the first entry that fits."""
    mass_kg: Annotated[float, Gt(0)] = 100.0
    """Mass at the epoch, propellant included, kg."""
    ballistic_m2_kg: BallisticCoefficient = 0.01
    """Ballistic coefficient Cd A / m, m^2/kg: what drag acts on."""
    ballistic_m2_kg_range: tuple[BallisticCoefficient, BallisticCoefficient] | None = None
    """Smallest and largest one that flight software may command by turning the vehicle; none for neither."""
    thruster: Thruster | None = None
    """None: no delta-v is executed."""
    attitude: Attitude | None = None
    """None: a point mass."""
    sensors: Sensors = field(default_factory=Sensors)
    """Sensors on board."""
