"""Instruments of a vehicle: what each measures of its surroundings, errors added. Their records: see `streams`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from madns_runtime.simulations.constellation.equipment import Magnetometer
from madns_runtime.simulations.constellation.geomagnetic_field import field_model
from madns_runtime.simulations.constellation.orbit.magnetic import decimal_year, inertial_field_t
from madns_runtime.simulations.constellation.orbit.quaternions import (
    from_rotation,
    multiply,
    rotate,
    rotation_between,
)
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene

Measured = tuple[float, ...]
Row = list[float]
"""Errors of one measurement."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Instrument:
    """Properties of one kind of sensor."""

    name: str
    """Of the reading, and of the stream of records unless that says otherwise."""
    measure: Callable[[Scene, Row], Measured | None]
    """Returns the measured values, or None if there is nothing to measure, such as no Sun."""
    digits: int
    """Decimals of the recorded values: beyond them lies nothing but noise of the sensor."""
    channels: int = 3
    """Errors that a measurement needs."""
    stream: str = ""
    is_unit: bool = False
    """Whether its values are of length 1: a direction or a quaternion."""
    is_mean: bool = False
    """Whether it measures the mean since its measurement before, and not an instant."""


def gnss(scene: Scene, error: Row) -> Measured:
    """Return position, m, and velocity, m/s: at any height, the antenna at the centre of mass."""
    return tuple(true + wrong for true, wrong in zip(scene.state, error, strict=False))


def gyro(scene: Scene, error: Row) -> Measured:
    """Return the body rates of a rigid body, rad/s."""
    return tuple(true + wrong for true, wrong in zip(scene.state[10:13], error, strict=True))


def star_tracker(scene: Scene, error: Row) -> Measured:
    """Return the quaternion of a rigid body, turned on by the errors about its axes, rad; nothing blinds it."""
    return multiply(scene.state[6:10], from_rotation(error))


def sun_sensor(scene: Scene, error: Row) -> Measured | None:
    """
    Return the unit vector to the Sun, turned by the errors, rad; None in the Earth's umbra.

    It sees all around; its axes are the body's, or the frame's without attitude.
    """
    direction = scene.sun_direction()
    if direction is None:
        return None
    x, y, z = scene.to_body(direction)
    a, b, c = error
    x, y, z = x + b * z - c * y, y + c * x - a * z, z + a * y - b * x
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def clock(scene: Scene, error: Row) -> Measured:
    """
    Return the time since the epoch that the vehicle believes it is, s.

    Its bias is an offset; the walk of it is the random walk of an oscillator's phase.
    """
    return (scene.t_s + error[0],)


class Accelerometer:
    """
    Specific force, that is acceleration other than gravity: thrust, impulses and drag, at the centre of mass.

    It integrates, as real ones do: what it says is the mean since the measurement before. So a burn between two
    measurements is not lost, and their products with the time between them add up to the change of velocity. An
    impulse, which has no duration, is spread over the measurement that it falls in. Its axes are the body's, or
    the frame's without attitude: thrust and drag of a tick turned as the body is in the middle of it, an impulse as at its end.
    """

    def __init__(self) -> None:
        self._sum_m_s = [0.0, 0.0, 0.0]
        self._since_s: float | None = None
        self._t_s = 0.0
        self._thrust_m_s = self._impulses_m_s = self._drag_m_s2 = (0.0, 0.0, 0.0)
        self._attitude: tuple[float, ...] = ()

    def feel(self, scene: Scene) -> None:
        """Take what acted since the tick before, in the body's axes; called every tick."""
        (thrust, impulses), step_s = scene.given_m_s(), scene.t_s - self._t_s
        attitude = scene.state[6:10]
        if self._since_s is None:
            self._since_s = scene.t_s
        else:
            change = zip(thrust, self._thrust_m_s, self._drag_m_s2, strict=True)
            x, y, z = (now - before + drag * step_s for now, before, drag in change)
            a, b, c = (
                now - before for now, before in zip(impulses, self._impulses_m_s, strict=True)
            )
            steady: Vector = (x, y, z)
            if attitude:
                half = [angle / 2.0 for angle in rotation_between(self._attitude, attitude)]
                steady = rotate(multiply(self._attitude, from_rotation(half)), steady)
            for axis, gained in enumerate(zip(steady, scene.to_body((a, b, c)), strict=True)):
                self._sum_m_s[axis] += sum(gained)
        self._thrust_m_s, self._impulses_m_s, self._attitude = thrust, impulses, attitude
        self._t_s, self._drag_m_s2 = scene.t_s, scene.drag_m_s2()

    def measure(self, scene: Scene, error: Row) -> Measured | None:
        """Return the mean specific force since the measurement before, m/s^2; None for the first, which has none."""
        if self._since_s is None or scene.t_s <= self._since_s:
            return None
        share = 1.0 / (scene.t_s - self._since_s)
        x, y, z = (gained * share for gained in self._sum_m_s)
        self._sum_m_s, self._since_s = [0.0, 0.0, 0.0], scene.t_s
        a, b, c = error
        return x + a, y + b, z + c


class FluxGate:
    """
    Three axes along the body's; along the frame's without attitude.

    Args:
        settings: Which field.
        scene: Where: the model is taken at the run's epoch, since it changes by 1e-3 in a year.

    Raises:
        MissingExtraError: The IGRF is wanted and its coefficients are not installed.
    """

    def __init__(self, settings: Magnetometer, scene: Scene) -> None:
        year = decimal_year(scene.days)
        self._field_t = field_model(settings.field, year)

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...]:
        """Return the field, T."""
        x, y, z = scene.state[:3]
        bx, by, bz = scene.to_body(inertial_field_t(self._field_t, (x, y, z), scene.gmst_rad))
        a, b, c = error
        return bx + a, by + b, bz + c
