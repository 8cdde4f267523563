"""
Accelerations of truth, all vehicles at once. Pure.

Zonal harmonics are gradients of -mu Jn R^n Pn(sin lat) / r^(n+1), the Earth's pole being TEME's z
axis. The numba propagator has the same mathematics for one vehicle; a test holds the two together.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.atmosphere import drag_m_s2
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_RADIUS_M_MIN
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters

Array = NDArray[np.float64]
Force = Callable[[Array, Array, Array, PropagationParameters], Array]
"""Of positions (3, N) in m, their squares (N,), velocities (3, N) in m/s: accelerations (3, N) in m/s^2."""
Acceleration = Callable[[Array, Array], Array]
"""Of positions (3, N) in m and velocities (3, N) in m/s: accelerations (3, N) in m/s^2."""


def two_body(r: Array, r2: Array, _v: Array, parameters: PropagationParameters) -> Array:
    """Return the acceleration of a point mass, see `Force`."""
    return np.asarray((-parameters.gravity.mu_m3_s2 / (r2 * np.sqrt(r2))) * r)


def j2(r: Array, r2: Array, _v: Array, parameters: PropagationParameters) -> Array:
    """Return the acceleration of the Earth's oblateness, see `Force`."""
    gravity = parameters.gravity
    scale = (1.5 * gravity.j2 * gravity.mu_m3_s2 * gravity.radius_m**2) / (r2 * r2 * np.sqrt(r2))
    return _zonal(r, scale * (5.0 * r[2] * r[2] / r2 - 1.0), 2.0 * scale * r[2])


def j3(r: Array, r2: Array, _v: Array, parameters: PropagationParameters) -> Array:
    """Return the acceleration of the Earth's pear shape, see `Force`."""
    gravity = parameters.gravity
    scale = (0.5 * gravity.j3 * gravity.mu_m3_s2 * gravity.radius_m**3) / (r2 * r2 * np.sqrt(r2))
    sine2 = r[2] * r[2] / r2
    radial = scale * (35.0 * sine2 - 15.0) * r[2] / r2
    return _zonal(r, radial, scale * (15.0 * sine2 - 3.0))


def j4(r: Array, r2: Array, _v: Array, parameters: PropagationParameters) -> Array:
    """Return the acceleration of the fourth zonal harmonic, see `Force`."""
    gravity = parameters.gravity
    constant = 0.125 * gravity.j4 * gravity.mu_m3_s2 * gravity.radius_m**4
    scale = constant / (r2 * r2 * r2 * np.sqrt(r2))
    sine2 = r[2] * r[2] / r2
    radial = scale * ((315.0 * sine2 - 210.0) * sine2 + 15.0)
    return _zonal(r, radial, scale * (140.0 * sine2 - 60.0) * r[2])


def drag(r: Array, r2: Array, v: Array, parameters: PropagationParameters) -> Array:
    """Return the drag of an atmosphere that turns with the Earth, see `Force`."""
    if parameters.ballistic_m2_kg is None:
        return np.zeros_like(r)
    ballistic, radius_m = parameters.ballistic_m2_kg, parameters.gravity.radius_m
    return drag_m_s2(r, r2, v, ballistic_m2_kg=ballistic, radius_m=radius_m)


FORCES: dict[str, Force] = {"two_body": two_body, "j2": j2, "j3": j3, "j4": j4, "drag": drag}
"""A new force is one function and one line here, and its name in parameters.py."""


def acceleration_of(parameters: PropagationParameters) -> Acceleration:
    """Return the sum of the forces and thrust that *parameters* ask for."""
    forces = [FORCES[name] for name in dict.fromkeys(parameters.forces)]
    thrust = None if parameters.thrust_m_s2 is None else parameters.thrust_m_s2.T

    def acceleration(r: Array, v: Array) -> Array:
        r2 = np.maximum(np.einsum("in,in->n", r, r), GRAVITY_RADIUS_M_MIN**2)
        total = forces[0](r, r2, v, parameters)
        for force in forces[1:]:
            total += force(r, r2, v, parameters)
        if thrust is not None:
            total += thrust
        return total

    return acceleration


def _zonal(r: Array, radial: Array, along_axis: Array) -> Array:
    """Return radial * r - along_axis * z."""
    total = radial * r
    total[2] -= along_axis
    return np.asarray(total)
