"""
Actuators of a vehicle: what it lacks for a command, the real change, errors and failures included, or why there is none.

Pure. Chance is drawn for a name, (seed, agent, number of the command), not in turn: what one command gets
never depends on when, or after which others, the host heard of it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from madns_runtime.simulations.constellation.command_numbers import COMMANDS_MAX
from madns_runtime.simulations.constellation.equipment import (
    Magnetorquers,
    ReactionWheels,
    Thruster,
    Vehicle,
)
from madns_runtime.simulations.constellation.messages import Command
from madns_runtime.simulations.constellation.thrust import Vector
from madns_runtime.simulations.constellation.truth.maneuvers.effects import (
    ARC_S_MIN,
    scaled,
)
from madns_runtime.simulations.constellation.truth.maneuvers.tank import (
    ROUNDING_SHARE,
    Tank,
)

STANDARD_GRAVITY_M_S2 = 9.80665
"""By definition; specific impulse in seconds is exhaust velocity over it."""
DELTA_V_M_S_MIN = 1e-12
"""Less does not show in the last digit of an orbit's velocity."""
TORQUE_N_M_MIN = 1e-15
"""Less than wheels can give is nothing."""
DIPOLE_A_M2_MIN = 1e-12
"""Less turns nothing."""
WHEELS_FAILED = "the wheels have failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class ActuatorRefusal:
    """Why an actuator does not carry a command out."""

    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Burn:
    """Change of velocity that a thruster gives."""

    vector: Vector
    """Change of velocity in the command's frame, m/s, errors included."""
    propellant_kg: float
    """Used for it."""
    burnt: float
    """The same as a share of the vehicle's mass before it."""
    duration_s: float
    """0 for an impulse."""

    @property
    def magnitude_m_s(self) -> float:
        """Magnitude of the change of velocity."""
        return math.hypot(*self.vector)


def number_fault(command: Command) -> str:
    """Return which of a command's numbers is none that a command can have; empty if they can be."""
    times_s = (command.commanded_s, command.phase_s, command.at_s, command.duration_s)
    numbers = (*times_s, *command.vector)
    if not all(map(math.isfinite, numbers)):
        return f"expected finite numbers, got {numbers}"
    if not 0 <= command.number < COMMANDS_MAX:
        return f"expected a number from 0 on below {COMMANDS_MAX}, got {command.number}"
    return ""


def vehicle_fault(command: Command, vehicle: Vehicle) -> str:
    """Return what a vehicle lacks for a command, or what of it is out of bounds; empty if it can be carried out."""
    if command.kind == "delta_v":
        return _burn_fault(command, vehicle)
    if command.kind == "ballistic":
        return _ballistic_fault(command, vehicle)
    attitude = vehicle.attitude
    if attitude is None:
        return f"a {command.kind} on a vehicle without attitude"
    if command.kind == "dipole" and attitude.magnetorquers is None:
        return "the vehicle has no magnetorquers"
    if command.duration_s < ARC_S_MIN:
        return f"expected a duration of at least {ARC_S_MIN} s, got {command.duration_s:g} s"
    return ""


def _burn_fault(command: Command, vehicle: Vehicle) -> str:
    if vehicle.thruster is None:
        return "the vehicle has no thruster"
    if command.frame == "body" and vehicle.attitude is None:
        return "body axes of a vehicle without attitude"
    return ""


def _ballistic_fault(command: Command, vehicle: Vehicle) -> str:
    allowed, value = vehicle.ballistic_m2_kg_range, command.vector[0]
    if allowed is None:
        return "the vehicle's ballistic coefficient cannot be changed"
    low, high = allowed
    if not low <= value <= high:
        return f"expected {low:g} to {high:g} m^2/kg, got {value:g}"
    return ""


def chance_of(seed: int, agent: str, number: int) -> np.random.Generator:
    """Return the chance of one command."""
    return np.random.default_rng([seed, zlib.crc32(agent.encode()), number])


def fire(
    thruster: Thruster,
    tank: Tank,
    delta_v_m_s: Vector,
    random: np.random.Generator,
    share: float = 1.0,
) -> Burn | ActuatorRefusal:
    """
    Return what a thruster makes of a commanded change of velocity; books nothing.

    Args:
        thruster: Of the vehicle.
        tank: What is left.
        delta_v_m_s: As commanded, in any frame, m/s.
        random: Three numbers are drawn.
        share: Of the change of velocity, that a weak thruster gives; it may be nothing at all.

    Source: Tsiolkovsky's equation, dm = m (1 - exp(-dv / (g0 Isp))).
    """
    magnitude, along, across = random.standard_normal(3).tolist()
    commanded = math.hypot(*delta_v_m_s)
    if commanded < DELTA_V_M_S_MIN:
        return ActuatorRefusal(reason=f"a change of velocity of {commanded:.4g} m/s")
    impulse_n_s = tank.mass_kg * commanded
    if impulse_n_s < thruster.minimum_impulse_n_s:
        return ActuatorRefusal(
            reason=f"an impulse of {impulse_n_s:.4g} N s, the least is {thruster.minimum_impulse_n_s:g} N s"
        )
    needed_kg = propellant_of(thruster, tank.mass_kg, commanded)
    if needed_kg > tank.propellant_kg + tank.mass_kg * ROUNDING_SHARE:
        return ActuatorRefusal(
            reason=f"needs {needed_kg:.4g} kg of propellant, {tank.propellant_kg:.4g} kg are left"
        )
    given = share * max(0.0, 1.0 + magnitude * thruster.magnitude_error)
    sigma = math.radians(thruster.direction_error_deg)
    vector = scaled(_turned(delta_v_m_s, along * sigma, across * sigma), given)
    used_kg = propellant_of(thruster, tank.mass_kg, commanded * given)
    if used_kg > tank.propellant_kg:
        # An error cannot burn what is not there.
        used_kg = tank.propellant_kg
        most_m_s = exhaust_m_s(thruster) * -math.log1p(-used_kg / tank.mass_kg)
        vector = scaled(vector, most_m_s / math.hypot(*vector))
    duration_s = 0.0
    if thruster.thrust_n is not None:
        duration_s = used_kg * exhaust_m_s(thruster) / thruster.thrust_n
    burnt = used_kg / tank.mass_kg
    return Burn(vector=vector, propellant_kg=used_kg, burnt=burnt, duration_s=duration_s)


def propellant_of(thruster: Thruster, mass_kg: float, delta_v_m_s: float) -> float:
    """Return the propellant, kg, that a change of velocity costs a vehicle of some mass."""
    return -mass_kg * math.expm1(-delta_v_m_s / exhaust_m_s(thruster))


def exhaust_m_s(thruster: Thruster) -> float:
    """Return the exhaust velocity."""
    return thruster.isp_s * STANDARD_GRAVITY_M_S2


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelTurn:
    """Change of rates that reaction wheels give."""

    torque_n_m: Vector
    """Mean torque over the time commanded, body axes, N m."""
    limits: tuple[str, ...] = ()
    """Limits that kept it below what was commanded."""


def turn(
    wheels: ReactionWheels | None,
    held_n_m_s: tuple[Vector, Vector],
    torque_n_m: Vector,
    duration_s: float,
    random: np.random.Generator,
) -> WheelTurn | ActuatorRefusal:
    """
    Return what the wheels make of a commanded torque.

    Args:
        wheels: Of the vehicle; None for exact torques without limit.
        held_n_m_s: The least and the most that the wheels hold from the beginning of the torque on, by what was
            commanded before, body axes; a torque takes up its opposite.
        torque_n_m: As commanded, body axes.
        duration_s: For how long, > 0.
        random: One number is drawn.

    Wheels that saturate on the way give the mean torque that fills them exactly at the end.
    """
    if not any(torque_n_m):
        return ActuatorRefusal(reason="a torque of 0 N m")
    if wheels is None:
        return WheelTurn(torque_n_m=torque_n_m)
    factor = 1.0 + float(random.standard_normal()) * wheels.torque_error
    limits: list[str] = []
    given = [0.0, 0.0, 0.0]
    for axis, commanded in enumerate(torque_n_m):
        torque = min(max(commanded, -wheels.torque_n_m_max), wheels.torque_n_m_max)
        if torque != commanded:
            limits.append(f"{'xyz'[axis]}: {wheels.torque_n_m_max:g} N m at most")
        torque *= factor
        least, most = held_n_m_s[0][axis], held_n_m_s[1][axis]
        low, high = most - wheels.momentum_n_m_s_max, least + wheels.momentum_n_m_s_max
        possible = min(max(torque, min(0.0, low / duration_s)), max(0.0, high / duration_s))
        if possible != torque:
            limits.append(f"{'xyz'[axis]}: wheels saturate")
        given[axis] = possible
    if max(map(abs, given)) < TORQUE_N_M_MIN:
        return ActuatorRefusal(reason="the wheels are saturated")
    x, y, z = given
    return WheelTurn(torque_n_m=(x, y, z), limits=tuple(limits))


@dataclass(frozen=True, slots=True, kw_only=True)
class Magnetisation:
    """Dipole that magnetorquers give."""

    dipole_a_m2: Vector
    """All through the time commanded, body axes, A m^2."""
    limits: tuple[str, ...] = ()
    """Limits that kept it below what was commanded."""


def magnetise(
    torquers: Magnetorquers, dipole_a_m2: Vector, random: np.random.Generator
) -> Magnetisation | ActuatorRefusal:
    """
    Return what the magnetorquers make of a commanded dipole.

    Args:
        torquers: Of the vehicle.
        dipole_a_m2: As commanded, body axes.
        random: One number is drawn.
    """
    if max(map(abs, dipole_a_m2)) < DIPOLE_A_M2_MIN:
        return ActuatorRefusal(reason="a dipole of 0 A m^2")
    factor = 1.0 + float(random.standard_normal()) * torquers.dipole_error
    most = torquers.dipole_a_m2_max
    x, y, z = (min(max(commanded, -most), most) for commanded in dipole_a_m2)
    limits = tuple(
        f"{axis}: {most:g} A m^2 at most"
        for axis, commanded in zip("xyz", dipole_a_m2, strict=True)
        if abs(commanded) > most
    )
    return Magnetisation(dipole_a_m2=scaled((x, y, z), factor), limits=limits)


Given = Burn | WheelTurn | Magnetisation
"""Effect of a command on an actuator."""


def vector_of(given: Given) -> Vector:
    """Return the change of velocity, torque or dipole that an actuator gives."""
    if isinstance(given, Burn):
        return given.vector
    return given.torque_n_m if isinstance(given, WheelTurn) else given.dipole_a_m2


class ActuatorFailures:
    """Weak thrusters and wheels without torque of all vehicles; several failures of one may be in force at a time."""

    def __init__(self) -> None:
        self._factors: dict[int, dict[int, float]] = {}
        """By failure: by vehicle, the share that its thruster gives."""
        self._without_wheels: dict[int, frozenset[int]] = {}

    def weaken(self, failure: int, factors: Mapping[int, float]) -> None:
        """Put a failure in force: the share that the thrusters of some vehicles give."""
        self._factors[failure] = dict(factors)

    def fail_wheels(self, failure: int, vehicles: frozenset[int]) -> None:
        """Put a failure in force: the wheels of some vehicles take no torque."""
        self._without_wheels[failure] = vehicles

    def lift(self, failure: int) -> None:
        """End a failure."""
        self._factors.pop(failure, None)
        self._without_wheels.pop(failure, None)

    def share(self, vehicle: int) -> float:
        """Return the share of a commanded change of velocity that a vehicle's thruster gives, before its own errors."""
        return math.prod(each.get(vehicle, 1.0) for each in self._factors.values())

    def refusal(self, vehicle: int, kind: str) -> str:
        """Return why a command of a kind cannot be carried out; empty if it can."""
        has_failed = any(vehicle in each for each in self._without_wheels.values())
        return WHEELS_FAILED if kind == "torque" and has_failed else ""


def _turned(vector: Vector, along_rad: float, across_rad: float) -> Vector:
    """Return a vector turned by small angles about two axes normal to it and to each other."""
    if along_rad == 0.0 and across_rad == 0.0:
        return vector
    v = np.array(vector)
    length = float(np.linalg.norm(v))
    # Any direction that is not the vector's own gives the first normal.
    helper = np.zeros(3)
    helper[int(np.argmin(np.abs(v)))] = 1.0
    first = np.cross(v, helper)
    first /= np.linalg.norm(first)
    second = np.cross(v / length, first)
    turned = v / length + math.tan(along_rad) * first + math.tan(across_rad) * second
    x, y, z = (turned * (length / np.linalg.norm(turned))).tolist()
    return x, y, z
