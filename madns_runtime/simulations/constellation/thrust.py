"""
A thruster at work: even force and flow, and a vehicle that gets lighter, by the rocket equation. Pure.

With g the share of the mass at the beginning that is burnt a second, mass is m0 (1 - g tau) and

    acceleration    a(tau) = a0 / (1 - g tau)
    velocity        a0 integral = -a0 ln(1 - g tau) / g
    way             a0 double integral = a0 ((1 - g tau) ln(1 - g tau) + g tau) / g^2

Source: Tsiolkovsky's equation and its integral.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]

SERIES_BELOW = 1e-3
"""Of the share burnt: below it the integrals are sums of powers, which lose no digits and need no g > 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Thrust:
    """Acceleration other than gravity and drag, inertial, all through an arc."""

    start_s: float
    """Simulated time at which the arc begins."""
    acceleration_m_s2: Vector
    """At start_s, inertial."""
    burnt_1_s: float = 0.0
    """Share of the mass at start_s that is burnt a second; below 1 over the whole arc."""

    @classmethod
    def of(cls, delta_v_m_s: Vector, start_s: float, end_s: float, burnt: float) -> Thrust:
        """Return the thrust that gives a change of velocity while the share *burnt* of the mass is burnt."""
        duration_s = end_s - start_s
        gain_s = velocity_gain_s(duration_s, burnt / duration_s)
        x, y, z = delta_v_m_s
        return cls(
            start_s=start_s,
            acceleration_m_s2=(x / gain_s, y / gain_s, z / gain_s),
            burnt_1_s=burnt / duration_s,
        )

    def at(self, t_s: float) -> Vector:
        """Return the acceleration at a time of the arc, m/s^2."""
        x, y, z = self.acceleration_m_s2
        lighter = 1.0 - self.burnt_1_s * (t_s - self.start_s)
        return x / lighter, y / lighter, z / lighter

    def gains(self, from_s: float, until_s: float) -> tuple[float, float]:
        """
        Return what the arc gives between two of its times, as multiples of `acceleration_m_s2`.

        Returns:
            Change of velocity, s, and the way that it alone adds until *until_s*, s^2.
        """
        before_s, after_s = from_s - self.start_s, until_s - self.start_s
        had_s = velocity_gain_s(before_s, self.burnt_1_s)
        gained_s = velocity_gain_s(after_s, self.burnt_1_s) - had_s
        way_s2 = way_gain_s2(after_s, self.burnt_1_s) - way_gain_s2(before_s, self.burnt_1_s)
        return gained_s, way_s2 - had_s * (after_s - before_s)

    def parabola(self, from_s: float, until_s: float) -> tuple[float, float]:
        """
        Return the parabola nearest to the way between two times, for whoever can fly at one acceleration only.

        The difference has no mean and no first moment, so that gravity does not feel it: it may be added
        afterwards. With an acceleration of slope b over a leg L the way is mean tau^2 / 2 - b L tau^2 / 4 +
        b tau^3 / 6, and nearest to tau^3 in that sense is -0.3 L^2 tau + 1.2 L tau^2.

        Returns:
            Velocity at the beginning, s, and acceleration, as multiples of `acceleration_m_s2`.
        """
        leg_s = until_s - from_s
        velocity_s, way_s2 = self.gains(from_s, until_s)
        mean = velocity_s / leg_s
        slope_1_s = 12.0 * (mean / 2.0 - way_s2 / leg_s**2) / leg_s
        return -0.05 * slope_1_s * leg_s**2, mean - 0.1 * slope_1_s * leg_s


def velocity_gain_s(tau_s: float, burnt_1_s: float) -> float:
    """Return the change of velocity after *tau_s*, over the acceleration at the beginning."""
    y = burnt_1_s * tau_s
    if y < SERIES_BELOW:
        return tau_s * (1.0 + y * (1 / 2 + y * (1 / 3 + y * (1 / 4 + y * (1 / 5 + y / 6)))))
    return -math.log1p(-y) / burnt_1_s


def way_gain_s2(tau_s: float, burnt_1_s: float) -> float:
    """Return the way after *tau_s* from rest, over the acceleration at the beginning."""
    y = burnt_1_s * tau_s
    if y < SERIES_BELOW:
        series = 1 / 2 + y * (1 / 6 + y * (1 / 12 + y * (1 / 20 + y * (1 / 30 + y / 42))))
        return tau_s * tau_s * series
    return ((1.0 - y) * math.log1p(-y) + y) / (burnt_1_s * burnt_1_s)
