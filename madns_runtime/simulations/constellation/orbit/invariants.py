"""
Invariants of an exact propagation: the health of a propagator in numbers. Pure.

The specific orbital energy contains the whole potential of the forces at work, else it swings with
them and hides the drift. Under J2 the magnitude of angular momentum swings too; its component along
the Earth's axis stays.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.constants import GravityModel

ENERGY, MOMENTUM, MOMENTUM_Z = range(3)
"""Columns of `invariants`."""


def specific_energy(
    states: NDArray[np.float64],
    gravity: GravityModel,
    *,
    with_j2: bool,
    also: Collection[str] = (),
) -> NDArray[np.float64]:
    """
    Return kinetic plus potential energy per mass.

    Args:
        states: Positions (m) and velocities (m/s), shape (..., 6), any inertial frame whose z axis
            is the Earth's.
        gravity: Constants.
        with_j2: Whether the potential includes the J2 term.
        also: Further terms of the potential: j3, j4.

    Returns:
        Energy, shape (...), J/kg; negative for bound orbits.
    """
    r2 = np.sum(states[..., :3] ** 2, axis=-1)
    radius = np.sqrt(r2)
    energy = 0.5 * np.sum(states[..., 3:] ** 2, axis=-1) - gravity.mu_m3_s2 / radius
    if with_j2:
        scale = 0.5 * gravity.mu_m3_s2 * gravity.j2 * gravity.radius_m**2
        energy = energy + scale / (r2 * radius) * (3.0 * states[..., 2] ** 2 / r2 - 1.0)
    sine = states[..., 2] / radius
    if "j3" in also:
        scale = 0.5 * gravity.mu_m3_s2 * gravity.j3 * gravity.radius_m**3
        energy = energy + scale / r2**2 * (5.0 * sine**3 - 3.0 * sine)
    if "j4" in also:
        scale = 0.125 * gravity.mu_m3_s2 * gravity.j4 * gravity.radius_m**4
        energy = energy + scale / (r2**2 * radius) * (35.0 * sine**4 - 30.0 * sine**2 + 3.0)
    return np.asarray(energy, dtype=np.float64)


def angular_momentum(states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the specific angular momentum vector, shape (..., 3), m^2/s, of states (..., 6)."""
    return np.asarray(np.cross(states[..., :3], states[..., 3:]), dtype=np.float64)


def invariants(
    states: NDArray[np.float64],
    gravity: GravityModel,
    *,
    with_j2: bool,
    also: Collection[str] = (),
) -> NDArray[np.float64]:
    """
    Return energy (J/kg), magnitude and z component of angular momentum (m^2/s).

    Args:
        states: Shape (..., 6), m and m/s.
        gravity: Constants.
        with_j2: Whether the potential includes the J2 term.
        also: Further terms of the potential: j3, j4.

    Returns:
        Shape (..., 3), columns ENERGY, MOMENTUM, MOMENTUM_Z.
    """
    momentum = angular_momentum(states)
    energy = specific_energy(states, gravity, with_j2=with_j2, also=also)
    magnitude = np.linalg.norm(momentum, axis=-1)
    return np.stack((energy, magnitude, momentum[..., 2]), axis=-1)
