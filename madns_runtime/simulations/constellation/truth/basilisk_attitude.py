"""Rigid bodies by Basilisk, which our own are compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.parameters import BasiliskPropagator
from madns_runtime.simulations.constellation.truth.attitude import RigidBody
from madns_runtime.simulations.constellation.truth.basilisk_propagator import NS_PER_S, whole_steps
from madns_runtime.simulations.constellation.truth.basilisk_simulation import Design, Simulation
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters

Array = NDArray[np.float64]


def propagate_rigid_bodies(
    bodies: Sequence[RigidBody],
    states: Array,
    *,
    knots_s: Array,
    parameters: PropagationParameters,
    torques: Array,
) -> Array:
    """
    Return the states of all rigid bodies at all knots.

    Args:
        bodies: M of them, without wheels.
        states: Shape (M, 13): position and velocity (m, m/s, TEME), quaternion (scalar last, TEME to
            body), body rates (rad/s).
        knots_s: Times after *states*, shape (K,), s: the first and its multiples.
        parameters: With the basilisk propagator's settings.
        torques: Shape (M, 3), N m, body axes, constant all through the call.

    Returns:
        Shape (M, K, 13); of the two quaternions of an attitude any one.

    Raises:
        ConfigurationError: A body has wheels, or the knots are not multiples of the first.
    """
    settings = parameters.settings
    assert isinstance(settings, BasiliskPropagator)
    if any(body.wheels_n_m_s is not None for body in bodies):
        raise ConfigurationError("basilisk: expected rigid bodies without wheels")
    if not np.allclose(knots_s, knots_s[0] * np.arange(1, len(knots_s) + 1), rtol=1e-12):
        raise ConfigurationError(f"basilisk: expected multiples of the first knot, got {knots_s}")
    step_ns, steps = whole_steps(
        round(float(knots_s[0]) * NS_PER_S), round(settings.step_s * NS_PER_S)
    )
    simulation = Simulation(
        Design(
            count=len(bodies),
            step_ns=step_ns,
            knot_ns=step_ns * steps,
            gravity=parameters.gravity,
            has_j2=parameters.has_j2,
            has_thrust=True,
            inertias_kg_m2=tuple(body.inertia_kg_m2 for body in bodies),
            have_gravity_gradient=tuple(body.has_gravity_gradient for body in bodies),
        )
    )
    return simulation.run(
        states, len(knots_s), thrust_m_s2=parameters.thrust_m_s2, torques_n_m=torques
    )
