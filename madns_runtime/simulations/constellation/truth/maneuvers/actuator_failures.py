"""Actuators that have failed for a while: weak thrusters, wheels without torque. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping

from madns_runtime.simulations.constellation.thrust import Vector

WHEELS_FAILED = "the wheels have failed"


class ActuatorFailures:
    """The failures of all vehicles; several of one vehicle may be in force at a time."""

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

    def given(self, vehicle: int, delta_v_m_s: Vector) -> Vector:
        """Return what a vehicle's thruster makes of a commanded change of velocity, m/s, before its own errors."""
        if not self._factors:
            return delta_v_m_s
        factor = math.prod(each.get(vehicle, 1.0) for each in self._factors.values())
        x, y, z = delta_v_m_s
        return (factor * x, factor * y, factor * z)

    def refusal(self, vehicle: int, kind: str) -> str:
        """Return why a command of a kind cannot be carried out; empty if it can."""
        has_failed = any(vehicle in each for each in self._without_wheels.values())
        return WHEELS_FAILED if kind == "torque" and has_failed else ""
