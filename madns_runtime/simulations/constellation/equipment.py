"""
Equipment and body of a vehicle, as a person writes them in a scenario: thruster, wheels, body, sensors.

As in `parameters`: frozen dataclasses with bounds, the standard library and annotated_types alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen

from madns_runtime.simulations.constellation.actuation import Actuation
from madns_runtime.simulations.constellation.stimulus import Stimulus

FieldName = Literal["dipole", "igrf"]
"""Model of the Earth's magnetic field."""


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
class Magnetorquers:
    """Errors and limits that turn a commanded magnetic dipole into a real one; the Earth's field turns the body by it."""

    dipole_a_m2_max: Annotated[float, Gt(0), Le(10_000)]
    """Largest dipole along each body axis, A m^2."""
    dipole_error: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Standard deviation of the dipole, as a share of it."""
    field: FieldName | None = None
    """The Earth's field in truth that turns the body. dipole: tilted dipole; igrf: the extra `igrf`, on the host as
    well; none for that of the vehicle's magnetometer, without one dipole."""


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
    magnetorquers: Magnetorquers | None = None
    """Actuators of commanded magnetic dipoles; none for no dipoles."""


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

    field: FieldName = "dipole"
    """dipole: tilted dipole; igrf: the extra `igrf`."""


Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorDevice:
    """A sensor that is hardware: its readings are alignment (scale raw - bias), in the sensor's unit, of a channel."""

    device: Annotated[str, MinLen(3)]
    """Device of the run and its channel, such as imu.gyro."""
    alignment: tuple[Triple, Triple, Triple] | tuple[float, float, float, float] | None = None
    """From the device's axes to the body's: a matrix by its rows, or a quaternion, scalar last; none where they are one."""
    scale: float | Triple = 1.0
    """Factor of the channel's values, or one for each of its axes."""
    bias: Triple = (0.0, 0.0, 0.0)
    """Rest of the scaled values where there is nothing to measure, in the channel's unit."""
    model: SensorNoise | None = None
    """Model that is recorded beside it, with its errors; none for no more than truth beside it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MagnetometerDevice(SensorDevice):
    """A magnetometer that is hardware."""

    model: Magnetometer | None = None
    """Model that is recorded beside it, with its errors; its field is that of the truth beside it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StarTrackerDevice:
    """A star tracker that is hardware: a channel of quaternions, scalar last, inertial to the device's axes."""

    device: Annotated[str, MinLen(3)]
    """Device of the run and its channel, such as tracker.attitude."""
    alignment: tuple[Triple, Triple, Triple] | tuple[float, float, float, float] | None = None
    """Rotation from the device's axes to the body's; none where they are one."""
    model: SensorNoise | None = None
    """Model that is recorded beside it, with its errors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockDevice:
    """A clock that is hardware: scale raw - bias is the time since the epoch."""

    device: Annotated[str, MinLen(3)]
    """Device of the run and its channel, such as gps.time."""
    scale: float = 1.0
    """Factor of the channel's values."""
    bias: float = 0.0
    """Scaled value at the epoch, in the channel's unit."""
    model: SensorNoise | None = None
    """Model that is recorded beside it, with its errors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssDevice:
    """A receiver that is hardware: two channels of one device, taken at one time."""

    device: Annotated[str, MinLen(3)]
    """Device of the run and its channel of positions, such as gps.position."""
    velocity: Annotated[str, MinLen(1)]
    """Channel of velocities of the same device."""
    frame: Literal["ECEF", "TEME"] = "ECEF"
    """Frame of the channels: ECEF is turned into the run's frame by sidereal time."""
    model: Gnss | None = None
    """Model that is recorded beside it, with its errors."""


AnySensorDevice = SensorDevice | StarTrackerDevice | ClockDevice | GnssDevice
"""Settings of a sensor that is hardware."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """Sensors of a vehicle, models or hardware (those with `device`); absent ones measure nothing."""

    gnss: Gnss | GnssDevice | None = None
    """Position and velocity."""
    gyro: SensorNoise | SensorDevice | None = None
    """Body rates, rad/s."""
    accelerometer: SensorNoise | SensorDevice | None = None
    """Specific force, mean since the measurement before, in body axes, m/s^2."""
    magnetometer: Magnetometer | MagnetometerDevice | None = None
    """Magnetic field."""
    star_tracker: SensorNoise | StarTrackerDevice | None = None
    """Quaternion, scalar last, inertial to body; noise in rad about each body axis."""
    sun_sensor: SensorNoise | SensorDevice | None = None
    """Unit vector to the Sun in body axes; nothing in eclipse; noise in rad."""
    clock: SensorNoise | ClockDevice | None = None
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
    actuation: tuple[Actuation, ...] = ()
    """Devices whose values are commands of the vehicle, with or without flight software."""
    stimuli: tuple[Stimulus, ...] = ()
    """Truth that devices of the vehicle are given, ahead of its time."""
