"""Numerical integration in machine code, each vehicle at its own steps, in as many threads as wanted."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.plain_values import first_few
from madns_runtime.simulations.constellation.orbit import atmosphere
from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_FLATTENING,
    EARTH_RATE_RAD_S,
    GRAVITY_RADIUS_M_MIN,
)
from madns_runtime.simulations.constellation.parameters import NumbaPropagator
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators import numba_dop853
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import (
    FIRST_STEP_RAD,
)

try:
    from scipy.integrate import DOP853
except ImportError as error:
    raise MissingExtraError("scipy", "host") from error

Array = NDArray[np.float64]

WHY = {
    numba_dop853.STEP_TOO_SHORT: "no step passes",
    numba_dop853.TOO_MANY_STEPS: f"more than {numba_dop853.STEPS_MAX} steps",
}
FAULTS_MAX = 5
"""Vehicles that one message names."""


class NumbaDop853:
    """DOP853 for every vehicle by itself: its neighbours change none of its digits."""

    def propagate(
        self,
        states: Array,
        t0_s: float,
        knots_s: Array,
        parameters: PropagationParameters,
    ) -> Array:
        """
        Return states at the knots, see `Propagator.propagate`.

        Same method, forces and tolerances as scipy's; steps end on the last knot, and values between
        steps are of seventh order. Accuracy: tests/authorities.

        Raises:
            ConfigurationError: The integration failed; names the vehicles.
        """
        settings = parameters.settings
        assert isinstance(settings, NumbaPropagator)
        states = np.ascontiguousarray(states, dtype=np.float64)
        offsets_s = np.ascontiguousarray(knots_s - t0_s, dtype=np.float64)
        out = np.empty((len(states), len(knots_s), 6))
        vehicles = np.zeros((len(states), 4))
        if parameters.has_drag:
            vehicles[:, 0] = parameters.ballistic_m2_kg
        if parameters.thrust_m_s2 is not None:
            vehicles[:, 1:] = parameters.thrust_m_s2
        tables = (model_of(parameters), air(), tableau(), limits_of(settings))

        def share(part: slice) -> NDArray[np.int64]:
            outcomes: NDArray[np.int64] = numba_dop853.integrate(
                states[part], offsets_s, out[part], vehicles[part], tables
            )
            return outcomes

        threads = min(settings.threads, len(states))
        if threads == 1:
            outcomes = share(slice(None))
        else:
            edges = [len(states) * n // threads for n in range(threads + 1)]
            with ThreadPoolExecutor(threads) as pool:
                outcomes = np.concatenate(list(pool.map(share, map(slice, edges, edges[1:]))))
        _raise_failures(outcomes, t0_s, parameters)
        return out


def model_of(parameters: PropagationParameters) -> Array:
    """Return the model of `numba_dop853`, with a zero for each harmonic that is not in force."""
    gravity, forces = parameters.gravity, parameters.forces
    zonals = (
        gravity.mu_m3_s2 * value * gravity.radius_m**degree * (name in forces)
        for degree, name, value in (
            (2, "j2", gravity.j2),
            (3, "j3", gravity.j3),
            (4, "j4", gravity.j4),
        )
    )
    earth = (gravity.radius_m, EARTH_FLATTENING, EARTH_RATE_RAD_S, GRAVITY_RADIUS_M_MIN)
    return np.array((gravity.mu_m3_s2, *zonals, *earth))


def limits_of(settings: NumbaPropagator) -> Array:
    """Return the limits of `numba_dop853`."""
    kinks = (atmosphere.KINK_M_S, atmosphere.STEP_S_MIN)
    return np.array((settings.rtol, settings.atol_m, settings.step_s_max, FIRST_STEP_RAD, *kinks))


@lru_cache(maxsize=1)
def air() -> Array:
    """Return base heights, m, densities, kg/m^3, scale heights, m, and kinks, 1/m, shape (4, 28)."""
    layers = (
        atmosphere.HEIGHTS_M,
        atmosphere.DENSITIES_KG_M3,
        atmosphere.SCALE_HEIGHTS_M,
        atmosphere.KINKS_1_M,
    )
    return np.ascontiguousarray(np.stack(layers))


@lru_cache(maxsize=1)
def tableau() -> Array:
    """
    Return DOP853's coefficients as scipy has them, shape (22, 16).

    Rows 0 to 15 are the stages, of which row 12 is the step itself and 13 to 15 serve dense output;
    then both error estimates, then the four of dense output.
    """
    table = np.zeros((22, 16))
    table[:12, :12] = DOP853.A[:12, :12]
    table[12, :12] = DOP853.B
    table[13:16] = DOP853.A_EXTRA
    table[numba_dop853.ERROR_3, :13] = DOP853.E3
    table[numba_dop853.ERROR_5, :13] = DOP853.E5
    table[numba_dop853.DENSE :] = DOP853.D
    return table


def _raise_failures(
    outcomes: NDArray[np.int64], t0_s: float, parameters: PropagationParameters
) -> None:
    failed = np.flatnonzero(outcomes)
    if not len(failed):
        return
    faults = [
        f"{parameters.name_of(vehicle)}: numba DOP853 from {t0_s:g} s: {WHY[int(outcomes[vehicle])]}"
        for vehicle in failed.tolist()
    ]
    raise ConfigurationError(first_few(faults, FAULTS_MAX, "\n"))
