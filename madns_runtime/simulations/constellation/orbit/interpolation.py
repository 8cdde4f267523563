"""
Cubic Hermite interpolation between knots, of position and velocity and of attitude and body rates. Pure.

The error in position is at most h^4 / 384 times the fourth derivative: with knots 1 s apart, 2e-8 m
for a circular orbit at 780 km (n^4 r / 384), and the velocity's is below 7e-8 m/s.

Of attitude, within an interval the rotation since its first knot is a rotation vector, and that is the cubic
curve: both ends have the knots' attitude and rates. A body that spins steadily is met exactly, at any
rate below half a turn a knot; others to fourth order in the knots' distance in attitude, and to third
in the rates, which are the curve's own. Measured at knots 1 s apart against DOP853 (moments 12, 14, 9):
1e-14 rad and rad/s for a body that librates in orbit, 7e-12 rad and 2e-11 rad/s for one that tumbles
at 1 deg/s, 9e-9 and 3e-8 at 6 deg/s, 7e-6 and 2e-5 at 30 deg/s: as the fourth power of rate times knot. Of a
body like a plate (moments 1, 1.9, 2.8) it is twenty times as much: 2e-7 rad at 6 deg/s, 1e-4 at 30, 5e-3 at 88.
`knot_error_rad` tells it of the knots themselves.
Source of the Jacobians: Chirikjian, Stochastic Models, Information Theory, and Lie Groups, vol. 2, 10.8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.quaternions import (
    Numbers,
    Quaternion,
    Vector,
    from_rotation,
    multiply,
    rotation_between,
)

Coefficients = tuple[float, ...]
"""Twelve numbers: for x, y and z the four of a cubic in s = (t - t0) / h, constant first."""

SMALL_RAD = 1e-2
"""Below, series: what they leave out is less than the last digit."""
QUARTER_TURN_RAD = 1.5
LOOKS_MAX = 32
"""Places in a series of knots at which its error is looked for: 0.3 ms."""


def coefficients(first: Sequence[float], second: Sequence[float], knot_s: float) -> Coefficients:
    """
    Return the cubics between two knots, for `evaluate`.

    Args:
        first: Position (m) and velocity (m/s) at the first knot: six numbers.
        second: The same one knot later.
        knot_s: Time between the two, s.
    """
    # Written out, for it is in the hot path where a tick is as long as an interval.
    x, y, z, vx, vy, vz = first
    x_next, y_next, z_next, vx_next, vy_next, vz_next = second
    vx, vy, vz = vx * knot_s, vy * knot_s, vz * knot_s
    vx_next, vy_next, vz_next = vx_next * knot_s, vy_next * knot_s, vz_next * knot_s
    dx, dy, dz = x_next - x, y_next - y, z_next - z
    return (
        x,
        vx,
        3.0 * dx - 2.0 * vx - vx_next,
        vx + vx_next - 2.0 * dx,
        y,
        vy,
        3.0 * dy - 2.0 * vy - vy_next,
        vy + vy_next - 2.0 * dy,
        z,
        vz,
        3.0 * dz - 2.0 * vz - vz_next,
        vz + vz_next - 2.0 * dz,
    )


def evaluate(cubics: Coefficients, s: float, knot_s: float) -> tuple[float, ...]:
    """
    Return position (m) and velocity (m/s) within an interval: six plain numbers.

    The agent's hot path: no arrays, since three numbers cost numpy more in overhead than in work.

    Args:
        cubics: Of the interval, from `coefficients`.
        s: Part of the interval that has passed, 0 to 1.
        knot_s: Length of the interval, s.
    """
    x0, x1, x2, x3, y0, y1, y2, y3, z0, z1, z2, z3 = cubics
    s2, s3 = 2.0 * s, 3.0 * s
    return (
        x0 + s * (x1 + s * (x2 + s * x3)),
        y0 + s * (y1 + s * (y2 + s * y3)),
        z0 + s * (z1 + s * (z2 + s * z3)),
        (x1 + s2 * x2 + s3 * s * x3) / knot_s,
        (y1 + s2 * y2 + s3 * s * y3) / knot_s,
        (z1 + s2 * z2 + s3 * s * z3) / knot_s,
    )


def interpolate(
    knots: NDArray[np.float64], t_s: NDArray[np.float64], *, t0_s: float, knot_s: float
) -> NDArray[np.float64]:
    """
    Return states at many times from equally spaced knots.

    Args:
        knots: Positions (m) and velocities (m/s), shape (..., K, 6), K >= 2.
        t_s: Times, shape (M,), s, within the knots.
        t0_s: Time of the first knot, s.
        knot_s: Time between knots, s.

    Returns:
        States, shape (..., M, 6), m and m/s, in the knots' frame: to the bit what `evaluate` returns.

    Raises:
        ValueError: A time lies outside the knots.
    """
    position = (t_s - t0_s) / knot_s
    intervals = knots.shape[-2] - 1
    if position.size and (position.min() < -1e-9 or position.max() > intervals + 1e-9):
        raise ValueError(f"times: expected within {intervals} intervals, got {position!r}")
    index = np.clip(position.astype(np.intp), 0, intervals - 1)
    # In the order of `coefficients` and `evaluate`: an agent's tick and a table have the same digits.
    s = ((t_s - (t0_s + index * knot_s)) / knot_s)[:, None]
    first, second = knots[..., index, :], knots[..., index + 1, :]
    r0, v0 = first[..., :3], first[..., 3:] * knot_s
    rise, v1 = second[..., :3] - r0, second[..., 3:] * knot_s
    c2, c3 = 3.0 * rise - 2.0 * v0 - v1, v0 + v1 - 2.0 * rise
    r = r0 + s * (v0 + s * (c2 + s * c3))
    v = (v0 + (2.0 * s) * c2 + (3.0 * s) * s * c3) / knot_s
    return np.concatenate((r, v), axis=-1)


@dataclass(frozen=True, slots=True)
class AttitudeCurve:
    """The curve over one interval, for `evaluate_turn`."""

    start: Quaternion
    """Attitude at the first knot."""
    linear: Vector
    quadratic: Vector
    cubic: Vector
    """Of the rotation vector in s = (t - t0) / h, rad."""


def turn_between(first: Numbers, second: Numbers, knot_s: float) -> AttitudeCurve:
    """
    Return the curve between two knots.

    Args:
        first: Quaternion (scalar last, inertial to body, unit) and body rates (rad/s): seven numbers.
        second: The same one knot later; the sign of its quaternion does not matter.
        knot_s: Time between the two, s.
    """
    start = (first[0], first[1], first[2], first[3])
    end = rotation_between(start, second[:4])
    slopes = [rate * knot_s for rate in first[4:]]
    ends = _to_derivative(end, second[4], second[5], second[6])
    quadratic, cubic = [], []
    for axis in range(3):
        slope, other = slopes[axis], ends[axis] * knot_s
        quadratic.append(3.0 * end[axis] - 2.0 * slope - other)
        cubic.append(slope + other - 2.0 * end[axis])
    return AttitudeCurve(
        start,
        (slopes[0], slopes[1], slopes[2]),
        (quadratic[0], quadratic[1], quadratic[2]),
        (cubic[0], cubic[1], cubic[2]),
    )


def evaluate_turn(turn: AttitudeCurve, s: float, knot_s: float) -> tuple[float, ...]:
    """
    Return quaternion and body rates (rad/s) within an interval: seven plain numbers.

    Args:
        turn: Of the interval, from `turn_between`.
        s: Part of the interval that has passed, 0 to 1.
        knot_s: Length of the interval, s.
    """
    (lx, ly, lz), (qx, qy, qz), (cx, cy, cz) = turn.linear, turn.quadratic, turn.cubic
    x, y, z = (
        s * (lx + s * (qx + s * cx)),
        s * (ly + s * (qy + s * cy)),
        s * (lz + s * (qz + s * cz)),
    )
    twice, thrice = 2.0 * s, 3.0 * s * s
    dx = (lx + twice * qx + thrice * cx) / knot_s
    dy = (ly + twice * qy + thrice * cy) / knot_s
    dz = (lz + twice * qz + thrice * cz) / knot_s
    return multiply(turn.start, from_rotation((x, y, z))) + _to_rates((x, y, z), dx, dy, dz)


def knot_error_rad(rows: Sequence[Numbers], knot_s: float) -> float:
    """
    Return about how far attitude between knots is off, the worst of what is looked at, rad.

    Args:
        rows: Quaternion and body rates at knots of one motion, seven numbers each; fewer than three tell nothing: 0.
        knot_s: Time between two, s.

    From knots twice as far apart every other knot is foretold, which errs by 16 times as much, the order being
    four. Where two knots see more than half a turn, the curve is carried on to the knot after it: 64 times as much.
    """
    worst, last = 0.0, len(rows) - 2
    for first in range(0, last, max(2, 2 * math.ceil(last / 2 / LOOKS_MAX))):
        before, middle, after = rows[first], rows[first + 1], rows[first + 2]
        if math.hypot(*rotation_between(before[:4], middle[:4])) < QUARTER_TURN_RAD:
            turn = turn_between(before, after, 2.0 * knot_s)
            foretold, met, share = evaluate_turn(turn, 0.5, 2.0 * knot_s), middle, 16.0
        else:
            turn = turn_between(before, middle, knot_s)
            foretold, met, share = evaluate_turn(turn, 2.0, knot_s), after, 64.0
        off_rad = math.hypot(*rotation_between(foretold[:4], met[:4]))
        worst = max(worst, off_rad / share)
    return worst


def _to_rates(rotation: Vector, dx: float, dy: float, dz: float) -> Vector:
    """Return the body rates of a rotation vector that changes at (dx, dy, dz): its right Jacobian."""
    square = rotation[0] ** 2 + rotation[1] ** 2 + rotation[2] ** 2
    if square < SMALL_RAD**2:
        first = 0.5 - square / 24.0 + square * square / 720.0
        second = 1.0 / 6.0 - square / 120.0 + square * square / 5040.0
    else:
        angle = math.sqrt(square)
        first = (1.0 - math.cos(angle)) / square
        second = (angle - math.sin(angle)) / (square * angle)
    return _combine(rotation, (dx, dy, dz), -first, second)


def _to_derivative(rotation: Vector, wx: float, wy: float, wz: float) -> Vector:
    """Return how a rotation vector changes at body rates (wx, wy, wz): the inverse of `_to_rates`."""
    square = rotation[0] ** 2 + rotation[1] ** 2 + rotation[2] ** 2
    if square < SMALL_RAD**2:
        second = 1.0 / 12.0 + square / 720.0 + square * square / 30240.0
    else:
        half = 0.5 * math.sqrt(square)
        second = (1.0 - half / math.tan(half)) / square
    return _combine(rotation, (wx, wy, wz), 0.5, second)


def _combine(rotation: Vector, v: Vector, first: float, second: float) -> Vector:
    """Return v + first (rotation x v) + second (rotation x (rotation x v))."""
    x, y, z = rotation
    a, b, c = v
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        a + first * p + second * (y * r - z * q),
        b + first * q + second * (z * p - x * r),
        c + first * r + second * (x * q - y * p),
    )
