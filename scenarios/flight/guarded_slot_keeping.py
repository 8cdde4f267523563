"""
Slot keeping by a GNSS receiver that may be wrong: positions are checked against the vehicle's own dynamics.

Between two fixes the way follows from their velocities and from gravity:

    r1 - r0 = dt (v0 + v1) / 2 + dt^2 (a0 - a1) / 12

to millimetres in a minute, whatever burns of a metre per second were in between add some ten metres. A position
that jumps by more than `jump_m_max` against that is a receiver's fault, not an orbit: the jump is taken for the
receiver's new bias, and subtracted from then on. When the fault goes, it jumps back, and the bias with it. A bias
that grows slowly, or was there from the first fix on, is not found.

flight.settings: those of `slot_keeping`, and

    guards_gnss    whether it is done; false: fixes are believed (true)
    jump_m_max     m (150)
    gap_s_max      fixes farther apart are not compared: the newer one is believed, s (600)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from slot_keeping import SlotKeeping

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    Reading,
    Readings,
)
from madns_runtime.simulations.constellation.orbit.constants import EGM_96

Vector = NDArray[np.float64]


class GuardedSlotKeeping(SlotKeeping):
    """One satellite of the ring that does not believe its receiver all it says."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings."""
        super().setup(context)
        settings = context.settings
        is_guarded = settings.get("guards_gnss", True)
        if not isinstance(is_guarded, bool):
            raise ValueError(
                f"flight.settings.guards_gnss: expected true or false, got {is_guarded!r}"
            )
        jump_m, gap_s = (
            float(settings.get(*each)) for each in (("jump_m_max", 150.0), ("gap_s_max", 600.0))
        )
        self._guard = GnssGuard(jump_m_max=jump_m, gap_s_max=gap_s) if is_guarded else None

    def step(self, t_s: float, readings: Readings) -> None:
        """Correct the fix, and keep the slot."""
        fix = readings.get("gnss")
        if self._guard is not None and fix is not None:
            readings = {**readings, "gnss": self._guard.corrected(fix)}
        super().step(t_s, readings)

    def finish(self) -> Mapping[str, Any]:
        """Return what it believes at the end, of its receiver as well."""
        guard = self._guard
        found = {} if guard is None else {"jumps": guard.jumps, "bias_m": math.hypot(*guard.bias_m)}
        return {**super().finish(), **found}


class GnssGuard:
    """
    A receiver's bias, followed by its jumps against the dynamics.

    Args:
        jump_m_max: What a fix may be off, m.
        gap_s_max: Longest time from one fix to the next over which they are compared, s.
    """

    def __init__(self, *, jump_m_max: float, gap_s_max: float) -> None:
        self.jumps = 0
        self.bias_m: Vector = np.zeros(3)
        self._jump_m_max, self._gap_s_max = jump_m_max, gap_s_max
        self._last: tuple[float, Vector, Vector, Vector] | None = None

    def corrected(self, fix: Reading) -> Reading:
        """Return a fix without the bias that the jumps until then add up to."""
        values = np.array(fix.values[:6])
        velocity = values[3:]
        position = values[:3] - self.bias_m
        if self._last is not None:
            t_s, r_m, v_m_s, a_m_s2 = self._last
            passed_s = fix.t_s - t_s
            if 0.0 < passed_s <= self._gap_s_max:
                turned = passed_s**2 / 12.0 * (a_m_s2 - gravity(position))
                jump_m = position - r_m - 0.5 * passed_s * (v_m_s + velocity) - turned
                if math.hypot(*jump_m) > self._jump_m_max:
                    self.jumps += 1
                    self.bias_m = self.bias_m + jump_m
                    position = position - jump_m
        self._last = (fix.t_s, position, velocity, gravity(position))
        return Reading(fix.t_s, (*position.tolist(), *velocity.tolist(), *fix.values[6:]))


def gravity(r_m: Vector) -> Vector:
    """Return the acceleration by the Earth with J2, m/s^2, at a position in an inertial frame of its equator."""
    square_m2 = float(r_m @ r_m)
    flat = 1.5 * EGM_96.j2 * EGM_96.radius_m**2 / square_m2
    polar = 5.0 * float(r_m[2]) ** 2 / square_m2
    factors = 1.0 + flat * (np.array((1.0, 1.0, 3.0)) - polar)
    acceleration: Vector = -EGM_96.mu_m3_s2 / square_m2**1.5 * factors * r_m
    return acceleration
