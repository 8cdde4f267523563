"""Numerical integration of all vehicles at once by scipy's DOP853. The one place that imports scipy."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.orbit.atmosphere import kink_step_s
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.forces import acceleration_of

try:
    from scipy.integrate import DOP853
except ImportError as error:
    raise MissingExtraError("scipy", "host") from error

Array = NDArray[np.float64]

RTOL_MIN = 2.3e-14
"""scipy refuses less: 100 times the precision of a float64."""
VELOCITY_SHARE_PER_S = 1e-3
"""Absolute tolerance of velocity over that of position: about LEO's mean motion, 1/s."""
FIRST_STEP_RAD = 2.5
"""Angle of a circular orbit that a step covers at a relative tolerance of 1; measured: 4 pass."""
NODES = 0.5 - 0.5 * np.cos((np.arange(8) + 0.5) * np.pi / 8.0)
"""Chebyshev's nodes, parts of a step: through its values there goes one polynomial of seventh degree."""


class ScipyDop853:
    """DOP853 over all 6 N numbers in one call, at one step size for all vehicles."""

    def propagate(
        self,
        states: Array,
        t0_s: float,
        knots_s: Array,
        parameters: PropagationParameters,
    ) -> Array:
        """
        Return states at the knots, see `Propagator.propagate`.

        scipy judges a step by the root mean square error over all 6 N numbers, which would let one
        vehicle's error grow with sqrt(N): the tolerances are divided by it, so that what is set
        holds for each vehicle. Values between steps are of seventh order and settings.step_s_max
        keeps their error below the steps'; where the air is dense and bends, steps are shorter
        (`atmosphere.kink_step_s`). Accuracy: tests/authorities.

        Raises:
            ConfigurationError: The integration failed, or a state is not finite.
        """
        settings = parameters.settings
        assert isinstance(settings, ScipyPropagator)
        count = len(states)
        share = 1.0 / math.sqrt(count)
        rtol = max(settings.rtol * share, RTOL_MIN)
        atol = np.full((6, count), settings.atol_m * share)
        atol[3:] *= VELOCITY_SHARE_PER_S
        acceleration = acceleration_of(parameters)

        def derivative(_t: float, y: Array) -> Array:
            block = y.reshape(6, count)
            return np.concatenate((y[3 * count :], np.ravel(acceleration(block[:3], block[3:]))))

        # Time counts from t0: late in a long run its own digits would be lost.
        offsets_s = knots_s - t0_s
        span_s = float(offsets_s[-1])
        out = np.empty((count, len(knots_s), 6))
        knot = int(np.searchsorted(offsets_s, 0.0, side="right"))
        out[:, :knot] = states[:, None]
        if knot == len(knots_s):
            return out
        step_s = first_step_s(states, parameters.gravity.mu_m3_s2, rtol)
        solver = DOP853(
            derivative,
            0.0,
            states.T.ravel(),
            span_s,
            rtol=rtol,
            atol=atol.ravel(),
            first_step=min(step_s, settings.step_s_max, span_s),
            max_step=settings.step_s_max,
        )
        step_limit_s = _step_limit(parameters, settings.step_s_max)
        while knot < len(knots_s):
            if step_limit_s is not None:
                solver.max_step = step_limit_s(solver.y.reshape(6, count))
            message = solver.step()
            if solver.status == "failed":
                raise ConfigurationError(f"scipy DOP853 from {t0_s:g} s: {message}")
            end = int(np.searchsorted(offsets_s, solver.t, side="right"))
            if end > knot:
                out[:, knot:end] = states_in_step(solver, offsets_s[knot:end])
            knot = end
        return out


def _step_limit(
    parameters: PropagationParameters, step_s_max: float
) -> Callable[[Array], float] | None:
    """Return what tells the longest next step from states (6, N); None without drag."""
    ballistic, radius_m = parameters.ballistic_m2_kg, parameters.gravity.radius_m
    if not parameters.has_drag or ballistic is None:
        return None

    def limit(y: Array) -> float:
        return kink_step_s(y[:3], y[3:], ballistic, radius_m, step_s_max=step_s_max)

    return limit


def states_in_step(solver: DOP853, times_s: Array) -> Array:
    """
    Return the states at times within a solver's last step, shape (N, K, 6).

    The method's interpolant is a polynomial of seventh degree. Where many states are wanted it is
    evaluated at eight nodes only and its values are combined from there, which is ten times faster.
    """
    inside_s = times_s[times_s < solver.t]
    at_end = solver.y.reshape(6, -1, 1).transpose(1, 2, 0)
    if not len(inside_s):
        return np.repeat(at_end, len(times_s), axis=1)
    interpolant = solver.dense_output()
    if len(inside_s) <= len(NODES):
        found = interpolant(inside_s).reshape(6, -1, len(inside_s)).transpose(1, 2, 0)
    else:
        step_s = solver.t - solver.t_old
        at_nodes = interpolant(solver.t_old + NODES * step_s).reshape(6, -1, len(NODES))
        weights = lagrange_weights((inside_s - solver.t_old) / step_s)
        values = np.ascontiguousarray(at_nodes.transpose(1, 2, 0))
        # Only differences are combined: rounding of whole positions would be a saw tooth of 1e-8 m.
        found = weights @ (values - values[:, :1]) + values[:, :1]
    return np.concatenate((found, np.repeat(at_end, len(times_s) - len(inside_s), axis=1)), axis=1)


def lagrange_weights(parts: Array) -> Array:
    """Return the weights of the values at NODES that make the value at each part of a step, shape (K, 8)."""
    others = ~np.eye(len(NODES), dtype=bool)
    # Rows are nodes, columns the seven others.
    rest = np.broadcast_to(NODES, others.shape)[others].reshape(len(NODES), -1)
    weights = (parts[:, None, None] - rest) / (NODES[:, None] - rest)
    return np.asarray(weights.prod(axis=2))


def first_step_s(states: Array, mu_m3_s2: float, rtol: float) -> float:
    """
    Return a step that the vehicle nearest to the Earth will probably pass with, s.

    scipy's own choice begins far below and spends four steps where one is enough. A step that is too
    long costs one rejection; what is accepted is judged by its error either way.
    """
    r2_min = float(np.einsum("ni,ni->n", states[:, :3], states[:, :3]).min())
    return float(FIRST_STEP_RAD * rtol**0.125 * math.sqrt(r2_min**1.5 / mu_m3_s2))
