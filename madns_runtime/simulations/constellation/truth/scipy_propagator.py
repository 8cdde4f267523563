"""Numerical integration of all vehicles at once by scipy's DOP853. The one place that imports scipy."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import GravityModel
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters

try:
    from scipy.integrate import solve_ivp
except ImportError as error:
    raise MissingExtraError("scipy", "host") from error

Array = NDArray[np.float64]
Force = Callable[[Array, Array, GravityModel], Array]

RTOL_MIN = 2.3e-14
"""scipy refuses less: 100 times the precision of a float64."""
VELOCITY_SHARE_PER_S = 1e-3
"""Absolute tolerance of velocity over that of position: about LEO's mean motion, 1/s."""


def two_body(r: Array, r2: Array, gravity: GravityModel) -> Array:
    """Return the acceleration of a point mass, shape (3, N), m/s^2; r (3, N) in m, r2 its square."""
    return np.asarray(-gravity.mu_m3_s2 / (r2 * np.sqrt(r2)) * r)


def j2(r: Array, r2: Array, gravity: GravityModel) -> Array:
    """
    Return the acceleration of the Earth's oblateness, shape (3, N), m/s^2.

    The pole is TEME's z axis. Source: gradient of -mu J2 R^2 (3 sin^2 lat - 1) / (2 r^3).
    """
    scale = -1.5 * gravity.j2 * gravity.mu_m3_s2 * gravity.radius_m**2 / (r2 * r2 * np.sqrt(r2))
    five = 5.0 * r[2] * r[2] / r2
    return np.stack((scale * (1.0 - five), scale * (1.0 - five), scale * (3.0 - five))) * r


FORCES: dict[str, Force] = {"two_body": two_body, "j2": j2}
"""A new force is one function and one line here, and its name in parameters.py."""


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
        keeps their error below the steps'. Accuracy: tests/authorities.

        Raises:
            ConfigurationError: The integration failed, or a state is not finite.
        """
        settings = parameters.settings
        assert isinstance(settings, ScipyPropagator)
        count = len(states)
        forces = [FORCES[name] for name in settings.forces]
        share = 1.0 / math.sqrt(count)
        atol = np.full((6, count), settings.atol_m * share)
        atol[3:] *= VELOCITY_SHARE_PER_S

        def derivative(_t: float, y: Array) -> Array:
            block = y.reshape(6, count)
            r = block[:3]
            r2 = np.einsum("in,in->n", r, r)
            acceleration = sum(force(r, r2, parameters.gravity) for force in forces)
            return np.concatenate((y[3 * count :], np.ravel(acceleration)))

        span_s = float(knots_s[-1]) - t0_s
        if span_s == 0.0:
            return np.repeat(states[:, None, :], len(knots_s), axis=1)
        solution = solve_ivp(
            derivative,
            # Time counts from t0: late in a long run its own digits would be lost.
            (0.0, span_s),
            states.T.ravel(),
            method="DOP853",
            t_eval=knots_s - t0_s,
            rtol=max(settings.rtol * share, RTOL_MIN),
            atol=atol.ravel(),
            max_step=settings.step_s_max,
        )
        if not solution.success or not np.isfinite(solution.y).all():
            raise ConfigurationError(f"scipy DOP853 from {t0_s:g} s: {solution.message}")
        result = solution.y.reshape(6, count, len(knots_s))
        return np.ascontiguousarray(result.transpose(1, 2, 0))
