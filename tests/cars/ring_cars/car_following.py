"""
The Intelligent Driver Model. Pure.

Source: Treiber, Hennecke and Helbing, Congested traffic states in empirical observations and microscopic
simulations, Phys. Rev. E 62 (2000), 1805, equations 2 and 3 (exponent 4, without the jam distance s1).
"""

from __future__ import annotations

import math

from ring_cars.parameters import Driver


def acceleration_m_s2(driver: Driver, speed_m_s: float, approach_m_s: float, gap_m: float) -> float:
    """
    Return how a driver accelerates.

    Args:
        driver: The model's parameters.
        speed_m_s: Of the own car.
        approach_m_s: Own speed less that of the car ahead.
        gap_m: From the own front to the rear of the car ahead; infinity where there is none.
    """
    braking = 2.0 * math.sqrt(driver.acceleration_m_s2 * driver.deceleration_m_s2)
    dynamic_m = speed_m_s * driver.time_gap_s + speed_m_s * approach_m_s / braking
    desired_gap_m = driver.gap_min_m + max(0.0, dynamic_m)
    free = 1.0 - (speed_m_s / driver.desired_speed_m_s) ** 4
    return driver.acceleration_m_s2 * (free - (desired_gap_m / max(gap_m, 0.1)) ** 2)


def equilibrium_gap_m(driver: Driver, speed_m_s: float) -> float:
    """Return the gap at which cars of one speed keep it."""
    free = 1.0 - (speed_m_s / driver.desired_speed_m_s) ** 4
    return (driver.gap_min_m + speed_m_s * driver.time_gap_s) / math.sqrt(free)
