"""
Attitude quaternions: scalar last, inertial to body. Pure.

The quaternion (x, y, z, w) of an attitude turns a vector's inertial components into its body
components: v_body = R(q) v_inertial. Products are Hamilton's, so a body that turns at w (rad/s, body
axes) obeys q' = q (w, 0) / 2, and multiply(p, q) is p followed by q. Functions work on plain numbers,
since a board calls them every tick and three numbers cost numpy more in overhead than in work.
Source: Markley and Crassidis, Fundamentals of Spacecraft Attitude Determination and Control, 2.7, 2.9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Numbers = Sequence[float] | NDArray[np.float64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
"""Body axes on the frame's."""


def rotate(q: Numbers, v: Numbers) -> Vector:
    """Return the body components of a vector from its inertial ones; *q* of unit length."""
    x, y, z, w = q
    return _turn(-x, -y, -z, w, v)


def rotate_back(q: Numbers, v: Numbers) -> Vector:
    """Return the inertial components of a vector from its body ones; *q* of unit length."""
    x, y, z, w = q
    return _turn(x, y, z, w, v)


def multiply(p: Numbers, q: Numbers) -> Quaternion:
    """Return Hamilton's product: attitude *p*, and on from there by *q*."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


def conjugate(q: Numbers) -> Quaternion:
    """Return the quaternion of the opposite rotation, body to inertial."""
    x, y, z, w = q
    return -x, -y, -z, w


def normalised(q: Numbers) -> Quaternion:
    """
    Return *q* at unit length; its sign stays.

    Raises:
        ValueError: It has no length.
    """
    x, y, z, w = q
    length = math.hypot(x, y, z, w)
    if not 0.0 < length < math.inf:
        raise ValueError(f"quaternion: expected a finite length above 0, got {tuple(q)}")
    return x / length, y / length, z / length, w / length


def from_matrix(matrix: NDArray[np.float64]) -> Quaternion:
    """
    Return the quaternion, its scalar not negative, of a 3x3 rotation from inertial to body.

    Source: Shepperd, Quaternion from rotation matrix, JGC 1 (1978): the largest of the four is
    computed first, and the others from it without loss of digits.
    """
    m = np.asarray(matrix, dtype=np.float64).tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    candidates = (m[0][0], m[1][1], m[2][2], trace)
    largest = candidates.index(max(candidates))
    if largest == 3:
        q = (m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0], 1.0 + trace)
    else:
        a, b, c = largest, (largest + 1) % 3, (largest + 2) % 3
        found = [0.0] * 4
        found[a] = 1.0 + m[a][a] - m[b][b] - m[c][c]
        found[b] = m[a][b] + m[b][a]
        found[c] = m[a][c] + m[c][a]
        found[3] = m[b][c] - m[c][b]
        q = (found[0], found[1], found[2], found[3])
    unit = normalised(q)
    return (-unit[0], -unit[1], -unit[2], -unit[3]) if unit[3] < 0.0 else unit


def from_rotation(vector_rad: Numbers) -> Quaternion:
    """Return the quaternion of a rotation vector, rad: its direction is the axis, its length the angle."""
    x, y, z = vector_rad
    angle_rad = math.hypot(x, y, z)
    # sin(a/2)/a near 0; the next term is below the last digit.
    small = angle_rad < 1e-4
    scale = 0.5 - angle_rad * angle_rad / 48.0 if small else math.sin(0.5 * angle_rad) / angle_rad
    return x * scale, y * scale, z * scale, math.cos(0.5 * angle_rad)


def rotation_between(p: Numbers, q: Numbers) -> Vector:
    """Return the rotation vector that leads from attitude *p* to *q* the short way, rad, body axes."""
    x, y, z, w = multiply(conjugate(p), q)
    sine = math.hypot(x, y, z)
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return x * scale, y * scale, z * scale


def _turn(x: float, y: float, z: float, w: float, v: Numbers) -> Vector:
    """Return q v q*: two cross products, v + 2 w (u x v) + 2 u x (u x v)."""
    a, b, c = v
    p, q, r = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * p + y * r - z * q,
        b + w * q + z * p - x * r,
        c + w * r + x * q - y * p,
    )
