"""Faults of a command for which no time is the right one: it is none, or its vehicle lacks what it needs. Pure."""

from __future__ import annotations

import math

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import Command

ARC_S_MIN = 0.01
"""A burn that is over sooner is an impulse; a torque or a dipole is not given for less, s."""
COMMANDS_MAX = 2**31
"""Numbers of commands are below it."""


def number_fault(command: Command) -> str:
    """Return which of a command's numbers is none that a command can have; empty if they can be."""
    times_s = (command.commanded_s, command.phase_s, command.at_s, command.duration_s)
    numbers = (*times_s, *command.vector)
    if not all(map(math.isfinite, numbers)):
        return f"expected finite numbers, got {numbers}"
    if not 0 <= command.number < COMMANDS_MAX:
        return f"expected a number from 0 on, got {command.number}"
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
