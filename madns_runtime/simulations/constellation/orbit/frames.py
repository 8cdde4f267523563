"""Frames that move with a vehicle: radial, along-track, normal, and its body. Pure."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.quaternions import Numbers, Vector, rotate_back

Frame = Literal["inertial", "rtn", "body"]


def rtn_to_inertial(r: Numbers, v: Numbers) -> NDArray[np.float64]:
    """
    Return the matrix whose columns are the radial, along-track and normal directions.

    Args:
        r: Position, three numbers, m, inertial.
        v: Velocity, three numbers, m/s, inertial.

    Returns:
        Shape (3, 3): takes (radial, along-track, normal) components to inertial ones. Along-track
        is normal to the radius in the plane of motion: it is the velocity's direction only where
        the velocity has no radial part.

    Raises:
        ValueError: Position and velocity lie on one line and give no plane.
    """
    return np.array(_rtn_axes(r, v)).T


def vector_to_inertial(
    vector: Numbers, frame: Frame, r: Numbers, v: Numbers, q: Numbers | None = None
) -> Vector:
    """
    Return the inertial components of a vector that is given in *frame*.

    Args:
        vector: Three numbers, in any unit.
        frame: inertial, rtn or body.
        r: Position, m, inertial; for rtn.
        v: Velocity, m/s, inertial; for rtn.
        q: Attitude, scalar last, inertial to body; for body.

    Raises:
        ValueError: rtn of a motion along one line, or body without an attitude.
    """
    if frame == "inertial":
        x, y, z = vector
        return float(x), float(y), float(z)
    if frame == "rtn":
        a, b, c = vector
        radial, along, normal = _rtn_axes(r, v)
        x, y, z = (
            float(a * i + b * j + c * k) for i, j, k in zip(radial, along, normal, strict=True)
        )
        return x, y, z
    if q is None:
        raise ValueError("a vector in body axes: expected an attitude, got a point mass")
    return rotate_back(q, vector)


def _rtn_axes(r: Numbers, v: Numbers) -> tuple[Vector, Vector, Vector]:
    radial = _unit((float(r[0]), float(r[1]), float(r[2])))
    normal = _unit(_cross(radial, _unit((float(v[0]), float(v[1]), float(v[2])))))
    return radial, _cross(normal, radial), normal


def _unit(vector: Vector) -> Vector:
    x, y, z = vector
    length = math.hypot(x, y, z)
    if not 1e-12 < length < math.inf:
        raise ValueError("position and velocity: expected two directions that span a plane")
    return x / length, y / length, z / length


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
