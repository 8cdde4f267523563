"""
Classical osculating elements of an ellipse and back, one satellite at a time.

Plain floats rather than arrays: an agent computes its own elements between two ticks, where numpy's
overhead on three numbers would cost ten times the mathematics. Pure; SI units and rad.

Legend: a semi-major axis, e eccentricity, i inclination, raan right ascension of the ascending node,
argp argument of perigee, m mean anomaly, nu true anomaly, h angular momentum, n node vector, mu
gravitational parameter.

Where an angle has no meaning it is zero and the next one takes its part: without a node (equatorial
orbit) perigee is measured from the x axis; without a perigee (circular orbit) the anomaly is measured
from the node, or from the x axis if there is none either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Vector = tuple[float, float, float]

CIRCULAR_ECCENTRICITY = 1e-11
"""Below this, perigee is noise: 1e-11 of LEO's radius is 0.07 mm."""
EQUATORIAL_SINE = 1e-11
"""Below this sine of inclination, the node is noise."""

ITERATIONS_MAX = 50
"""Newton needs 3-6 from the starting value below; more means the input is not an ellipse."""
TOLERANCE_RAD = 1e-15


@dataclass(frozen=True, slots=True, kw_only=True)
class Elements:
    """Osculating classical elements; angles in rad, raan, argp and m within [0, 2 pi)."""

    a_m: float
    e: float
    i_rad: float
    raan_rad: float
    argp_rad: float
    mean_anomaly_rad: float


def state_from_elements(elements: Elements, mu_m3_s2: float) -> tuple[Vector, Vector]:
    """
    Return position (m) and velocity (m/s) in the inertial frame of the elements.

    Raises:
        ConvergenceError: The elements are not an ellipse's.

    Source: rotation of the perifocal frame by argp, i, raan (3-1-3).
    """
    e = elements.e
    eccentric = solve_kepler(elements.mean_anomaly_rad, e)
    nu = true_from_eccentric(eccentric, e)
    p = elements.a_m * (1.0 - e * e)
    radius = elements.a_m * (1.0 - e * math.cos(eccentric))
    speed = math.sqrt(mu_m3_s2 / p)
    cos_node, sin_node = math.cos(elements.raan_rad), math.sin(elements.raan_rad)
    cos_i, sin_i = math.cos(elements.i_rad), math.sin(elements.i_rad)
    cos_u, sin_u = math.cos(elements.argp_rad + nu), math.sin(elements.argp_rad + nu)
    cos_w, sin_w = math.cos(elements.argp_rad), math.sin(elements.argp_rad)
    along = -(sin_u + e * sin_w) * speed
    across = (cos_u + e * cos_w) * speed
    x, y = radius * cos_u, radius * sin_u
    r = (
        x * cos_node - y * cos_i * sin_node,
        x * sin_node + y * cos_i * cos_node,
        y * sin_i,
    )
    v = (
        along * cos_node - across * cos_i * sin_node,
        along * sin_node + across * cos_i * cos_node,
        across * sin_i,
    )
    return r, v


def elements_from_state(r_m: Vector, v_m_s: Vector, mu_m3_s2: float) -> Elements:
    """
    Return the osculating elements of a bound orbit.

    Args:
        r_m: Position in an inertial frame, m.
        v_m_s: Velocity in the same frame, m/s.
        mu_m3_s2: Gravitational parameter, m^3/s^2.

    Raises:
        ValueError: The state is not that of an ellipse (parabolic, hyperbolic or straight).
    """
    a_m, e, i_rad, raan_rad, argp_rad, mean_anomaly_rad = element_numbers((*r_m, *v_m_s), mu_m3_s2)
    return Elements(
        a_m=a_m,
        e=e,
        i_rad=i_rad,
        raan_rad=raan_rad,
        argp_rad=argp_rad,
        mean_anomaly_rad=mean_anomaly_rad,
    )


def element_numbers(
    state: Sequence[float], mu_m3_s2: float
) -> tuple[float, float, float, float, float, float]:
    """
    Return the same as plain numbers, in the order of `Elements`: an object costs a third of the mathematics.

    Args:
        state: Position (m) and velocity (m/s) in an inertial frame, six numbers.
        mu_m3_s2: Gravitational parameter, m^3/s^2.

    Raises:
        ValueError: The state is not that of an ellipse (parabolic, hyperbolic or straight).
    """
    x, y, z, vx, vy, vz = state
    radius = math.sqrt(x * x + y * y + z * z)
    rv = x * vx + y * vy + z * vz
    v2 = vx * vx + vy * vy + vz * vz
    alpha = 2.0 / radius - v2 / mu_m3_s2
    hx, hy, hz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    h = math.sqrt(hx * hx + hy * hy + hz * hz)
    if alpha <= 0.0 or h == 0.0:
        raise ValueError(f"expected a bound orbit, got 1/a = {alpha!r} 1/m, h = {h!r} m^2/s")
    # e cos(nu) and e sin(nu) lose no digits for small e, which the eccentricity vector would.
    p = h * h / mu_m3_s2
    e_cos, e_sin = p / radius - 1.0, rv * h / (mu_m3_s2 * radius)
    e = math.hypot(e_cos, e_sin)
    if e >= 1.0:  # by rounding: a line, or all but open
        raise ValueError(f"expected a bound orbit, got e = {e!r}")
    sine = math.hypot(hx, hy)
    equatorial = sine < EQUATORIAL_SINE * h
    # Unit vectors to the node and, a quarter turn on, within the plane.
    nx, ny = (1.0, 0.0) if equatorial else (-hy / sine, hx / sine)
    mx, my, mz = -hz * ny / h, hz * nx / h, (hx * ny - hy * nx) / h
    u = math.atan2(x * mx + y * my + z * mz, x * nx + y * ny)
    circular = e < CIRCULAR_ECCENTRICITY
    nu = u if circular else math.atan2(e_sin, e_cos)
    return (
        1.0 / alpha,
        0.0 if circular else e,
        math.atan2(sine, hz),
        0.0 if equatorial else _turn(math.atan2(ny, nx)),
        0.0 if circular else _turn(u - nu),
        _turn(mean_from_true(nu, 0.0 if circular else e)),
    )


def _turn(angle_rad: float) -> float:
    """Return the angle within [0, 2 pi)."""
    angle = math.fmod(angle_rad, math.tau)
    if angle < 0.0:
        angle += math.tau
    return 0.0 if angle >= math.tau else angle


class ConvergenceError(ArithmeticError):
    """Kepler's equation was not solved within ITERATIONS_MAX."""


def solve_kepler(mean_anomaly_rad: float, eccentricity: float) -> float:
    """
    Return the eccentric anomaly E that solves M = E - e sin E.

    Args:
        mean_anomaly_rad: M, rad, any number of turns.
        eccentricity: e, 0 <= e < 1.

    Returns:
        E, rad, within half a turn of zero.

    Raises:
        ConvergenceError: Unsolved after ITERATIONS_MAX.

    Newton's method kept inside a bracket that always holds the root, so that it converges for
    every ellipse. Accuracy: |E - e sin E - M| of a few 1e-16 of a turn.
    """
    if not 0.0 <= eccentricity < 1.0:
        raise ConvergenceError(f"eccentricity: expected 0 <= e < 1, got {eccentricity!r}")
    m = math.remainder(mean_anomaly_rad, math.tau)
    low, high = m - eccentricity, m + eccentricity
    anomaly = m + eccentricity * math.sin(m)
    for _ in range(ITERATIONS_MAX):
        error = anomaly - eccentricity * math.sin(anomaly) - m
        if error > 0.0:
            high = anomaly
        else:
            low = anomaly
        step = error / (1.0 - eccentricity * math.cos(anomaly))
        following = anomaly - step
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - anomaly) <= TOLERANCE_RAD * max(1.0, abs(anomaly)):
            return following
        anomaly = following
    # At the perigee of a very long ellipse steps of the tolerance are lost in the rounding of the error.
    if high - low > 1e-12 and abs(error) > TOLERANCE_RAD * abs(anomaly):
        raise ConvergenceError(f"M {mean_anomaly_rad!r} rad, e {eccentricity!r}: unsolved")
    return anomaly


def true_from_eccentric(eccentric_anomaly_rad: float, eccentricity: float) -> float:
    """Return the true anomaly, rad, within half a turn of zero."""
    half = 0.5 * eccentric_anomaly_rad
    return 2.0 * math.atan2(
        math.sqrt(1.0 + eccentricity) * math.sin(half),
        math.sqrt(1.0 - eccentricity) * math.cos(half),
    )


def mean_from_true(true_anomaly_rad: float, eccentricity: float) -> float:
    """Return the mean anomaly of an ellipse, rad, within half a turn of zero."""
    half = 0.5 * true_anomaly_rad
    eccentric = 2.0 * math.atan2(
        math.sqrt(1.0 - eccentricity) * math.sin(half),
        math.sqrt(1.0 + eccentricity) * math.cos(half),
    )
    return eccentric - eccentricity * math.sin(eccentric)
