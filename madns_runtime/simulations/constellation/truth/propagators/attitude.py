"""
Truth of rigid bodies: attitude and body rates along the orbit.

No force of the model depends on attitude, so the scenario's own propagator computes the orbit, to the
last digit as for a point mass, and attitude is integrated along it: with every propagator, also SGP4.
One that integrates attitude itself (PropagatorProperties.turns_bodies) is asked for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    load_propagator,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import RTOL_MIN

try:
    from scipy.integrate import solve_ivp
    from scipy.interpolate import CubicHermiteSpline
except ImportError as error:
    raise MissingExtraError("scipy", "host") from error

Array = NDArray[np.float64]

RTOL = 1e-12
ATOL = 1e-13
"""Of a quaternion's number; of a rate a hundredth of it a second."""
RATE_SHARE_PER_S = 1e-2
STEP_S_MAX = 30.0
SUPPORT_S = 5.0
"""Most between the positions that the gravity gradient is taken from: cubic between them errs 1e-5 m in
LEO, of which the torque feels 1e-12."""
STATE = slice(0, 6)
"""Columns of a rigid body's 13 numbers: position and velocity, m and m/s."""
ATTITUDE = slice(6, 13)
"""Quaternion, scalar last, inertial to body, and body rates, rad/s."""


class BodyPropagator(Protocol):
    """An engine that integrates attitude itself."""

    def propagate_bodies(
        self,
        bodies: Sequence[RigidBody],
        states: Array,
        *,
        offsets_s: Array,
        parameters: PropagationParameters,
    ) -> Array:
        """
        Return the states of rigid bodies some time later, shape (M, K, 13).

        Args:
            bodies: M of them, without wheels.
            states: Shape (M, 13), see `propagate_attitude`.
            offsets_s: Times after *states*, shape (K,), s, ascending from 0.
            parameters: Of the orbit.

        Returns:
            Orbits are those of points to the last digit; of the two quaternions of an attitude any one.

        Raises:
            ConfigurationError: A body has wheels.
        """


def propagate_attitude(
    bodies: Sequence[RigidBody],
    states: Array,
    *,
    t0_s: float,
    knots_s: Array,
    parameters: PropagationParameters,
) -> Array:
    """
    Return the states of all rigid bodies at all knots.

    Args:
        bodies: One a vehicle, M of them.
        states: At t0_s, shape (M, 13): position and velocity (m, m/s, TEME), quaternion (scalar last,
            TEME to body), body rates (rad/s).
        t0_s: Simulated time of *states*, s.
        knots_s: Times, shape (K,), s, ascending, none before t0_s.
        parameters: Of the orbit; what is one per vehicle is in the order of *bodies*.

    Returns:
        Shape (M, K, 13); quaternions of unit length, their signs continuous from *states* on.

    Raises:
        ConfigurationError: The integration failed, or a state is not finite.

    The gravity gradient is a point mass's. But for an engine's own the step is one for all bodies, so that who
    is in a call shows in the last digits. Accuracy: tests/constellation/test_rigid_bodies.py.
    Source: Markley and Crassidis, 3.3; gravity gradient 3.3.6.1.
    """
    by_engine = parameters.settings.PROPERTIES.turns_bodies
    times_s = knots_s if by_engine else support_times(t0_s, knots_s)
    orbit = propagate(states[:, STATE], t0_s, times_s, parameters)
    result = np.empty((len(bodies), len(knots_s), 13))
    result[:, :, STATE] = orbit[:, np.searchsorted(times_s, knots_s)]
    if knots_s[-1] == t0_s:
        result[:, :, ATTITUDE] = states[:, None, ATTITUDE]
        return result
    if by_engine:
        result[:, :, ATTITUDE] = _by_engine(bodies, states, knots_s - t0_s, parameters)
        return result
    position = CubicHermiteSpline(
        times_s - t0_s, orbit[..., :3].transpose(1, 2, 0), orbit[..., 3:].transpose(1, 2, 0)
    )
    derivative = _equations(bodies, position, parameters.gravity.mu_m3_s2)
    result[:, :, ATTITUDE] = _integrate(derivative, states[:, ATTITUDE], t0_s, knots_s)
    return result


def _by_engine(
    bodies: Sequence[RigidBody],
    states: Array,
    offsets_s: Array,
    parameters: PropagationParameters,
) -> Array:
    """Return quaternions, their signs continuous from *states* on, and rates, shape (M, K, 7)."""
    engine = cast("BodyPropagator", load_propagator(parameters.settings.kind))
    rows = engine.propagate_bodies(bodies, states, offsets_s=offsets_s, parameters=parameters)
    turned = np.array(rows[:, :, ATTITUDE])
    before = np.concatenate((states[:, None, ATTITUDE], turned[:, :-1]), axis=1)
    cosines = np.einsum("mki,mki->mk", turned[..., :4], before[..., :4])
    turned[..., :4] *= np.cumprod(np.where(cosines < 0.0, -1.0, 1.0), axis=1)[..., None]
    return turned


def support_times(t0_s: float, knots_s: Array) -> Array:
    """Return t0, the knots, and times between those that lie further apart than SUPPORT_S."""
    edges = knots_s if knots_s[0] == t0_s else np.concatenate(((t0_s,), knots_s))
    parts = np.ceil(np.diff(edges) / SUPPORT_S).astype(np.intp)
    if not np.any(parts > 1):
        return edges
    spread = zip(edges[:-1], edges[1:], parts, strict=True)
    filled = [np.linspace(start, end, count, endpoint=False) for start, end, count in spread]
    return np.concatenate((*filled, edges[-1:]))


def _integrate(
    derivative: Callable[[float, Array], Array], start: Array, t0_s: float, knots_s: Array
) -> Array:
    """Return quaternions and rates at the knots, shape (M, K, 7)."""
    count = len(start)
    # As for orbits: scipy judges all numbers together, and no body's error may hide among the others.
    share = 1.0 / math.sqrt(count)
    atol = np.full((7, count), ATOL * share)
    atol[4:] *= RATE_SHARE_PER_S
    solution = solve_ivp(
        derivative,
        (0.0, float(knots_s[-1]) - t0_s),
        start.T.ravel(),
        method="DOP853",
        t_eval=knots_s - t0_s,
        rtol=max(RTOL * share, RTOL_MIN),
        atol=atol.ravel(),
        max_step=STEP_S_MAX,
    )
    if not solution.success or not np.isfinite(solution.y).all():
        raise ConfigurationError(f"attitude, DOP853 from {t0_s:g} s: {solution.message}")
    turned = solution.y.reshape(7, count, len(knots_s)).transpose(1, 2, 0).copy()
    turned[..., :4] /= np.linalg.norm(turned[..., :4], axis=-1, keepdims=True)
    return np.asarray(turned, dtype=np.float64)


def _equations(
    bodies: Sequence[RigidBody], position: Callable[[float], Array], mu: float
) -> Callable[[float, Array], Array]:
    """Return the derivative of (7 M) quaternions and rates at a time after t0."""
    count = len(bodies)
    inertia = np.array([body.inertia_kg_m2 for body in bodies]).T
    torque = np.array([body.torque_n_m for body in bodies]).T
    gradient = np.array([3.0 * mu if body.has_gravity_gradient else 0.0 for body in bodies])
    has_gradient = bool(gradient.any())
    wheels = np.array([body.wheels_n_m_s or (0.0, 0.0, 0.0) for body in bodies]).T
    uptake = np.where([body.wheels_n_m_s is not None for body in bodies], torque, 0.0)

    def derivative(t_s: float, y: Array) -> Array:
        block = y.reshape(7, count)
        q, w, rates = block[:3], block[3], block[4:]
        acting = torque - _cross(rates, inertia * rates + wheels - uptake * t_s)
        if has_gradient:
            r = position(t_s)
            r2 = np.einsum("in,in->n", r, r)
            across = 2.0 * _cross(q, r)
            # q is unit but for the integrator's error, which the torque does not feel.
            r_body = r - w * across + _cross(q, across)
            acting = acting + gradient / (r2 * r2 * np.sqrt(r2)) * _cross(r_body, inertia * r_body)
        change = np.empty((7, count))
        change[:3] = 0.5 * (w * rates + _cross(q, rates))
        change[3] = -0.5 * np.einsum("in,in->n", q, rates)
        change[4:] = acting / inertia
        return change.ravel()

    return derivative


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products of columns, shape (3, M): numpy's own takes three times as long."""
    return np.stack(
        (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    )
