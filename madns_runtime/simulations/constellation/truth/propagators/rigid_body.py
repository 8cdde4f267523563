"""Rigid bodies, and their attitude at the epoch. Pure; `attitude` integrates it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from madns_runtime.simulations.constellation.equipment import Attitude, FieldName
from madns_runtime.simulations.constellation.orbit.frames import rtn_to_inertial
from madns_runtime.simulations.constellation.orbit.quaternions import (
    IDENTITY,
    Numbers,
    Vector,
    from_matrix,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidBody:
    """Rigid body, and how the Earth's gravity and field, and wheels, turn it."""

    inertia_kg_m2: Vector
    """Principal moments of inertia about body x, y, z, kg m^2, wheels included."""
    has_gravity_gradient: bool = True
    wheels_n_m_s: Vector | None = None
    """Momentum of its wheels at t0, body axes, N m s: they give the torque and take up its opposite.
    None: the torque is external."""
    torque_n_m: Vector = (0.0, 0.0, 0.0)
    """Commanded torque, body axes, N m; constant all through a call."""
    dipole_a_m2: Vector = (0.0, 0.0, 0.0)
    """Dipole of its magnetorquers, body axes, A m^2; constant all through a call. `magnetic_turn` alone heeds it."""
    field: FieldName = "dipole"
    """The Earth's field that acts on it."""

    @classmethod
    def of(
        cls,
        attitude: Attitude,
        wheels_n_m_s: Vector | None = None,
        *,
        field: FieldName = "dipole",
    ) -> RigidBody:
        """Return the body that a scenario describes."""
        return cls(
            inertia_kg_m2=attitude.inertia_kg_m2,
            has_gravity_gradient=attitude.has_gravity_gradient,
            wheels_n_m_s=wheels_n_m_s,
            field=field,
        )


def initial_attitude(attitude: Attitude, r: Numbers, v: Numbers) -> tuple[float, ...]:
    """
    Return quaternion and body rates (rad/s) at the epoch: seven numbers.

    Args:
        attitude: What the scenario says.
        r: Position, m, inertial.
        v: Velocity, m/s, inertial.

    Raises:
        ValueError: Nadir is asked for and the motion is along one line.
    """
    added = tuple(math.radians(rate) for rate in attitude.rates_deg_s)
    if attitude.initial == "inertial":
        return IDENTITY + added
    radial, along, normal = rtn_to_inertial(r, v).T
    # Rows are the body axes: x along-track, y against the normal, z to the Earth.
    quaternion = from_matrix(np.stack((along, -normal, -radial)))
    position = np.asarray(r, dtype=np.float64)
    momentum = float(np.linalg.norm(np.cross(position, np.asarray(v, dtype=np.float64))))
    turn_rad_s = momentum / float(position @ position)
    return (*quaternion, added[0], added[1] - turn_rad_s, added[2])
