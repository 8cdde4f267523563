"""
Mean elements of near-circular orbits: what remains when J2's short-period swing is taken away.

The osculating semi-major axis of a satellite at 780 km swings by 18 km in an orbit, its mean one stays.
Plain floats and one state at a time, as in `elements`; 20 us per call. Pure; SI units and rad.

First order in J2 after Brouwer (1959), in elements that have a meaning at e = 0: the terms of Lyddane's
modification for e -> 0, besides the semi-major axis, which is right for any e. What is left out is of
the order J2 e and J2^2: 31 m of swing in a, of which `mean_from_state` leaves 3 cm by way of the energy,
and 0.0002 deg in lam for e = 0.001. Long-period terms are part of the mean elements.

Legend: a semi-major axis, ex = e cos(argp), ey = e sin(argp), i inclination, raan right ascension of the
ascending node, lam = argp + M mean argument of latitude, u true argument of latitude, n mean motion,
g = J2/2 (R/a)^2, c and s cosine and sine of i.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from madns_runtime.simulations.constellation.orbit.constants import GravityModel

Vector = tuple[float, float, float]

INVERSIONS = 3
"""Fixed-point steps from osculating to mean; each gains three digits, J2's size."""
KEPLER_STEPS = 6
"""Newton steps for the eccentric argument of latitude; three are enough for e < 0.1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CircularElements:
    """Elements without a singularity at e = 0; mean or osculating, as the function says. Angles in rad."""

    a_m: float
    ex: float
    ey: float
    i_rad: float
    raan_rad: float
    lam_rad: float
    """Mean argument of latitude, within [0, 2 pi)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Secular rates of mean elements under J2, rad/s."""

    lam_rad_s: float
    raan_rad_s: float
    argp_rad_s: float


def osculating_from_state(r_m: Vector, v_m_s: Vector, mu_m3_s2: float) -> CircularElements:
    """
    Return the osculating elements of a bound orbit that is not equatorial.

    Args:
        r_m: Position, inertial frame, m.
        v_m_s: Velocity in the same frame, m/s.
        mu_m3_s2: Gravitational parameter, m^3/s^2.

    Raises:
        ValueError: The orbit is not an ellipse, or has no node.
    """
    x, y, z = r_m
    vx, vy, vz = v_m_s
    radius = math.sqrt(x * x + y * y + z * z)
    hx, hy, hz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    h = math.sqrt(hx * hx + hy * hy + hz * hz)
    sine = math.hypot(hx, hy)
    alpha = 2.0 / radius - (vx * vx + vy * vy + vz * vz) / mu_m3_s2
    if alpha <= 0.0 or sine <= 1e-9 * h:
        raise ValueError(f"expected a bound orbit with a node, got 1/a = {alpha!r} 1/m, h = {h!r}")
    a = 1.0 / alpha
    nx, ny = -hy / sine, hx / sine
    # Coordinates within the plane: to the node, and a quarter turn on.
    along = x * nx + y * ny
    across = (-x * hz * ny + y * hz * nx + z * sine) / h
    cos_u, sin_u = along / radius, across / radius
    e_cos = h * h / (mu_m3_s2 * radius) - 1.0
    e_sin = (x * vx + y * vy + z * vz) * h / (mu_m3_s2 * radius)
    ex, ey = e_cos * cos_u + e_sin * sin_u, e_cos * sin_u - e_sin * cos_u
    eta = math.sqrt(1.0 - ex * ex - ey * ey)
    b = 1.0 / (1.0 + eta)
    cos_f = ex + ((1.0 - b * ex * ex) * along - b * ex * ey * across) / (a * eta)
    sin_f = ey + ((1.0 - b * ey * ey) * across - b * ex * ey * along) / (a * eta)
    lam = math.atan2(sin_f, cos_f) - ex * sin_f + ey * cos_f
    return CircularElements(
        a_m=a,
        ex=ex,
        ey=ey,
        i_rad=math.atan2(sine, hz),
        raan_rad=math.atan2(ny, nx) % math.tau,
        lam_rad=lam % math.tau,
    )


def state_from_circular(
    elements: CircularElements, mu_m3_s2: float
) -> tuple[float, float, float, float, float, float]:
    """Return position (m) and velocity (m/s) of osculating elements, the inverse of `osculating_from_state`."""
    a, ex, ey = elements.a_m, elements.ex, elements.ey
    f = eccentric_argument(elements)
    cos_f, sin_f = math.cos(f), math.sin(f)
    b = 1.0 / (1.0 + math.sqrt(1.0 - ex * ex - ey * ey))
    along = a * ((1.0 - b * ey * ey) * cos_f + b * ex * ey * sin_f - ex)
    across = a * (b * ex * ey * cos_f + (1.0 - b * ex * ex) * sin_f - ey)
    rate = math.sqrt(mu_m3_s2 / a) / (1.0 - ex * cos_f - ey * sin_f)
    v_along = rate * (-(1.0 - b * ey * ey) * sin_f + b * ex * ey * cos_f)
    v_across = rate * (-b * ex * ey * sin_f + (1.0 - b * ex * ex) * cos_f)
    cos_n, sin_n = math.cos(elements.raan_rad), math.sin(elements.raan_rad)
    c, s = math.cos(elements.i_rad), math.sin(elements.i_rad)
    return (
        along * cos_n - across * c * sin_n,
        along * sin_n + across * c * cos_n,
        across * s,
        v_along * cos_n - v_across * c * sin_n,
        v_along * sin_n + v_across * c * cos_n,
        v_across * s,
    )


def eccentric_argument(elements: CircularElements) -> float:
    """Return F of lam = F - ex sin F + ey cos F, rad: Kepler's equation in these elements."""
    f, ex, ey = elements.lam_rad, elements.ex, elements.ey
    for _ in range(KEPLER_STEPS):
        sin_f, cos_f = math.sin(f), math.cos(f)
        step = (f - ex * sin_f + ey * cos_f - elements.lam_rad) / (1.0 - ex * cos_f - ey * sin_f)
        f -= step
        if abs(step) < 1e-15:
            break
    return f


def osculating_from_mean(mean: CircularElements, gravity: GravityModel) -> CircularElements:
    """
    Return osculating elements: mean ones and the short-period swing that J2 adds.

    Source: Brouwer, Solution of the problem of artificial satellite theory without drag, AJ 64 (1959),
    in the limit e -> 0 after Lyddane, AJ 68 (1963), that is
    d(ex + j ey) = g/2 (3 (3 c^2 - 1) exp(j u) + s^2 (3/2 exp(-j u) + 7/2 exp(3 j u))).
    """
    g, c, s = _constants(mean, gravity)
    f = eccentric_argument(mean)
    sin_f, cos_f = math.sin(f), math.cos(f)
    e2 = mean.ex * mean.ex + mean.ey * mean.ey
    b = 1.0 / (1.0 + math.sqrt(1.0 - e2))
    radius = 1.0 - mean.ex * cos_f - mean.ey * sin_f
    cos_u = ((1.0 - b * mean.ey**2) * cos_f + b * mean.ex * mean.ey * sin_f - mean.ex) / radius
    sin_u = (b * mean.ex * mean.ey * cos_f + (1.0 - b * mean.ex**2) * sin_f - mean.ey) / radius
    cos_2u, sin_2u = cos_u * cos_u - sin_u * sin_u, 2.0 * sin_u * cos_u
    cos_3u, sin_3u = cos_u * cos_2u - sin_u * sin_2u, sin_u * cos_2u + cos_u * sin_2u
    cube = 1.0 / radius**3
    circle, s2 = 3.0 * c * c - 1.0, s * s
    da = g * (circle * (cube - (1.0 - e2) ** -1.5) + 3.0 * s2 * cube * cos_2u)
    dex = 0.5 * g * (3.0 * circle * cos_u + s2 * (1.5 * cos_u + 3.5 * cos_3u))
    dey = 0.5 * g * (3.0 * circle * sin_u + s2 * (-1.5 * sin_u + 3.5 * sin_3u))
    return CircularElements(
        a_m=mean.a_m * (1.0 + da),
        ex=mean.ex + dex,
        ey=mean.ey + dey,
        i_rad=mean.i_rad + 1.5 * g * c * s * cos_2u,
        raan_rad=(mean.raan_rad + 1.5 * g * c * sin_2u) % math.tau,
        lam_rad=(mean.lam_rad + 0.75 * g * (3.0 - 5.0 * c * c) * sin_2u) % math.tau,
    )


def mean_from_osculating(osculating: CircularElements, gravity: GravityModel) -> CircularElements:
    """Return mean elements: the inverse of `osculating_from_mean`, by fixed-point steps."""
    mean = osculating
    for _ in range(INVERSIONS):
        swung = osculating_from_mean(mean, gravity)
        mean = CircularElements(
            a_m=mean.a_m + osculating.a_m - swung.a_m,
            ex=mean.ex + osculating.ex - swung.ex,
            ey=mean.ey + osculating.ey - swung.ey,
            i_rad=mean.i_rad + osculating.i_rad - swung.i_rad,
            raan_rad=(mean.raan_rad + wrapped(osculating.raan_rad - swung.raan_rad)) % math.tau,
            lam_rad=(mean.lam_rad + wrapped(osculating.lam_rad - swung.lam_rad)) % math.tau,
        )
    return mean


def mean_from_state(r_m: Vector, v_m_s: Vector, gravity: GravityModel) -> CircularElements:
    """
    Return the mean elements of a state, m and m/s, inertial with the Earth's axis as z.

    The semi-major axis comes from the energy, which J2 conserves exactly, instead of the map, whose
    first order leaves it 30 m of swing: Brouwer's da is what the energy's average over an orbit leaves.

    Raises:
        ValueError: The orbit is not an ellipse, or has no node.
    """
    mean = mean_from_osculating(osculating_from_state(r_m, v_m_s, gravity.mu_m3_s2), gravity)
    return replace(mean, a_m=_sma_of_energy(r_m, v_m_s, mean, gravity))


def _sma_of_energy(
    r_m: Vector, v_m_s: Vector, mean: CircularElements, gravity: GravityModel
) -> float:
    """Return a of E = -mu / 2a (1 + g (3 c^2 - 1) / eta^3), m."""
    g, c, _ = _constants(mean, gravity)
    mu = gravity.mu_m3_s2
    r2 = r_m[0] ** 2 + r_m[1] ** 2 + r_m[2] ** 2
    radius = math.sqrt(r2)
    oblate = 0.5 * gravity.j2 * gravity.radius_m**2 / r2 * (3.0 * r_m[2] ** 2 / r2 - 1.0)
    kinetic = 0.5 * (v_m_s[0] ** 2 + v_m_s[1] ** 2 + v_m_s[2] ** 2)
    energy = kinetic - mu / radius * (1.0 - oblate)
    rest = 1.0 - mean.ex**2 - mean.ey**2
    if rest <= 0.0:
        raise ValueError(f"expected mean elements of an ellipse, got 1 - e^2 = {rest!r}")
    cube = rest**-1.5
    return float(-0.5 * mu / energy * (1.0 + g * (3.0 * c * c - 1.0) * cube))


def secular_rates(mean: CircularElements, gravity: GravityModel) -> Rates:
    """
    Return how fast mean elements turn under J2, to first order.

    Source: Brouwer (1959); Vallado, Fundamentals of Astrodynamics, 4th ed., section 9.6.
    """
    g, c, _ = _constants(mean, gravity)
    eta = math.sqrt(1.0 - mean.ex**2 - mean.ey**2)
    n = math.sqrt(gravity.mu_m3_s2 / mean.a_m**3)
    scale = 1.5 * n * g / eta**4
    argp = scale * (5.0 * c * c - 1.0)
    return Rates(
        lam_rad_s=n + scale * eta * (3.0 * c * c - 1.0) + argp,
        raan_rad_s=-2.0 * scale * c,
        argp_rad_s=argp,
    )


def wrapped(angle_rad: float) -> float:
    """Return the angle within [-pi, pi)."""
    return (angle_rad + math.pi) % math.tau - math.pi


def _constants(mean: CircularElements, gravity: GravityModel) -> tuple[float, float, float]:
    """Return g, c, s."""
    g = 0.5 * gravity.j2 * (gravity.radius_m / mean.a_m) ** 2
    return g, math.cos(mean.i_rad), math.sin(mean.i_rad)
