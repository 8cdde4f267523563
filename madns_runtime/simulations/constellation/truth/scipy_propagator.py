"""Numerical integration of all vehicles at once by scipy's DOP853. The one place that imports scipy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.forces import acceleration_of
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters

try:
    from scipy.integrate import solve_ivp
except ImportError as error:
    raise MissingExtraError("scipy", "host") from error

Array = NDArray[np.float64]

RTOL_MIN = 2.3e-14
"""scipy refuses less: 100 times the precision of a float64."""
VELOCITY_SHARE_PER_S = 1e-3
"""Absolute tolerance of velocity over that of position: about LEO's mean motion, 1/s."""
FIRST_STEP_RAD = 2.5
"""Angle of a circular orbit that a step covers at a relative tolerance of 1; measured: 4 pass."""


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
        share = 1.0 / math.sqrt(count)
        rtol = max(settings.rtol * share, RTOL_MIN)
        atol = np.full((6, count), settings.atol_m * share)
        atol[3:] *= VELOCITY_SHARE_PER_S
        acceleration = acceleration_of(parameters)

        def derivative(_t: float, y: Array) -> Array:
            block = y.reshape(6, count)
            return np.concatenate((y[3 * count :], np.ravel(acceleration(block[:3], block[3:]))))

        span_s = float(knots_s[-1]) - t0_s
        if span_s == 0.0:
            return np.repeat(states[:, None, :], len(knots_s), axis=1)
        # solve_ivp takes no time twice.
        times_s, place = np.unique(knots_s - t0_s, return_inverse=True)
        step_s = first_step_s(states, parameters.gravity.mu_m3_s2, rtol)
        solution = solve_ivp(
            derivative,
            # Time counts from t0: late in a long run its own digits would be lost.
            (0.0, span_s),
            states.T.ravel(),
            method="DOP853",
            t_eval=times_s,
            rtol=rtol,
            atol=atol.ravel(),
            first_step=min(step_s, settings.step_s_max, span_s),
            max_step=settings.step_s_max,
        )
        if not solution.success:
            raise ConfigurationError(f"scipy DOP853 from {t0_s:g} s: {solution.message}")
        result = solution.y.reshape(6, count, len(times_s)).transpose(1, 2, 0)
        return np.ascontiguousarray(result if len(times_s) == len(knots_s) else result[:, place])


def first_step_s(states: Array, mu_m3_s2: float, rtol: float) -> float:
    """
    Return a step that the vehicle nearest to the Earth will probably pass with, s.

    scipy's own choice begins far below and spends four steps where one is enough. A step that is too
    long costs one rejection; what is accepted is judged by its error either way.
    """
    r2_min = float(np.einsum("ni,ni->n", states[:, :3], states[:, :3]).min())
    return float(FIRST_STEP_RAD * rtol**0.125 * math.sqrt(r2_min**1.5 / mu_m3_s2))
