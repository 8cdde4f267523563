"""
Attitude of one rigid body that magnetorquers turn: torque m x B, with the Earth's field along its orbit.

The orbit is given: no force of the model depends on attitude. One body at a time and in plain numbers, which for so
few of them is several times as fast as arrays: a vehicle may command ten dipoles per second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.truth.orbit_curves import (
    FieldCurve,
    OrbitCurve,
    earth_field,
)
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.attitude import (
    STEP_S_MAX,
)
from madns_runtime.simulations.constellation.truth.propagators.one_body_dop853 import (
    Derivative,
    StepControl,
    integrate,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody

Array = NDArray[np.float64]
RTOL = 1e-10
ATOL = np.array((1e-11,) * 4 + (1e-13,) * 3)
"""Of a quaternion's numbers and of rates, rad/s: a hundredth of what is lost between knots by a body that tumbles."""
FIRST_STEP_RAD = 0.4
"""Angle of a turn that a step covers; measured: nearly all pass."""


def turn_by_field(
    body: RigidBody,
    attitude: Array,
    orbit: OrbitCurve,
    times_s: Array,
    parameters: PropagationParameters,
) -> Array:
    """
    Return the attitude of one body at times after a first one.

    Args:
        body: With the torque and the dipole of all this time.
        attitude: At the first time, shape (7,): quaternion, scalar last, inertial to body; body rates, rad/s.
        orbit: That holds all this time.
        times_s: Shape (K + 1,), s, ascending.
        parameters: Epoch and gravity.

    Returns:
        At all but the first time, shape (K, 7); quaternions of unit length, their signs continuous.

    Raises:
        ConfigurationError: The integration failed.
        MissingExtraError: The IGRF is wanted and not installed.

    The method is that of `attitude.propagate_attitude`; the field is that along the integration,
    not of a knot. Accuracy: tests/constellation/test_magnetorquers.py.
    Source: Markley and Crassidis, 3.3 and 7.4.
    """
    field, from_s = None, float(times_s[0])
    if any(body.dipole_a_m2):
        field_t = earth_field(body.field, parameters.epoch_utc)
        field = FieldCurve(orbit, field_t, from_s, float(times_s[-1]))
    derivative = _equations(body, orbit, field, from_s, parameters.gravity.mu_m3_s2)
    rate_rad_s = float(np.linalg.norm(attitude[4:]))
    control = StepControl(
        rtol=RTOL,
        atol=ATOL,
        first_s=FIRST_STEP_RAD / max(rate_rad_s, FIRST_STEP_RAD / STEP_S_MAX),
        max_s=STEP_S_MAX,
    )
    turned = integrate(derivative, attitude, (times_s[1:] - from_s).tolist(), control)
    if not np.isfinite(turned).all():
        raise ConfigurationError(
            f"{parameters.name_of(0)}: attitude is not finite from {from_s:g} s"
        )
    turned[:, :4] /= np.linalg.norm(turned[:, :4], axis=1, keepdims=True)
    return turned


def _equations(
    body: RigidBody, orbit: OrbitCurve, field: FieldCurve | None, from_s: float, mu_m3_s2: float
) -> Derivative:
    """Return the derivative of quaternion and rates at a time after *from_s*."""
    ix, iy, iz = body.inertia_kg_m2
    tx, ty, tz = body.torque_n_m
    mx, my, mz = body.dipole_a_m2
    hx, hy, hz = body.wheels_n_m_s or (0.0, 0.0, 0.0)
    ux, uy, uz = body.torque_n_m if body.wheels_n_m_s is not None else (0.0, 0.0, 0.0)
    gradient = 3.0 * mu_m3_s2 if body.has_gravity_gradient else 0.0
    position = orbit.position

    def derivative(t_s: float, y: list[float]) -> Sequence[float]:
        qx, qy, qz, qw, wx, wy, wz = y
        lx = ix * wx + hx - ux * t_s
        ly = iy * wy + hy - uy * t_s
        lz = iz * wz + hz - uz * t_s
        ax, ay, az = tx - wy * lz + wz * ly, ty - wz * lx + wx * lz, tz - wx * ly + wy * lx
        if gradient:
            rx, ry, rz = position(from_s + t_s)
            r2 = rx * rx + ry * ry + rz * rz
            cx = 2.0 * (qy * rz - qz * ry)
            cy = 2.0 * (qz * rx - qx * rz)
            cz = 2.0 * (qx * ry - qy * rx)
            # q is unit but for the integrator's error, which the torque does not feel.
            bx = rx - qw * cx + qy * cz - qz * cy
            by = ry - qw * cy + qz * cx - qx * cz
            bz = rz - qw * cz + qx * cy - qy * cx
            share = gradient / (r2 * r2 * math.sqrt(r2))
            ax += share * by * bz * (iz - iy)
            ay += share * bz * bx * (ix - iz)
            az += share * bx * by * (iy - ix)
        if field is not None:
            rx, ry, rz = field.at(from_s + t_s)
            cx = 2.0 * (qy * rz - qz * ry)
            cy = 2.0 * (qz * rx - qx * rz)
            cz = 2.0 * (qx * ry - qy * rx)
            bx = rx - qw * cx + qy * cz - qz * cy
            by = ry - qw * cy + qz * cx - qx * cz
            bz = rz - qw * cz + qx * cy - qy * cx
            ax += my * bz - mz * by
            ay += mz * bx - mx * bz
            az += mx * by - my * bx
        return (
            0.5 * (qw * wx + qy * wz - qz * wy),
            0.5 * (qw * wy + qz * wx - qx * wz),
            0.5 * (qw * wz + qx * wy - qy * wx),
            -0.5 * (qx * wx + qy * wy + qz * wz),
            ax / ix,
            ay / iy,
            az / iz,
        )

    return derivative
