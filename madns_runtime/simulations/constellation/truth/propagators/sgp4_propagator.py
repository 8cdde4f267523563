"""
SGP4 as a propagator of whole fleets, with velocities that are its positions' derivatives.

SGP4's constants are WGS-72, those that the sets were fitted with, whatever gravity model numerical
propagation uses. Output is TEME, turned from km into m.
"""

from __future__ import annotations

from datetime import datetime
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import SECONDS_PER_DAY
from madns_runtime.simulations.constellation.truth.element_set import ElementSet
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    is_inside_earth,
)
from madns_runtime.simulations.constellation.truth.propagators.sgp4_records import (
    DECAYED,
    julian_date,
    to_satrec,
)

try:
    from sgp4.api import SGP4_ERRORS, SatrecArray
except ImportError as error:
    raise MissingExtraError("sgp4", "host") from error

DIFFERENCE_S = 1.0
"""Step of the central difference: its own error is 2e-10 m/s in LEO, SGP4's noise of 1e-5 m costs more."""
WEIGHTS = {-2.0: 1.0 / 12.0, -1.0: -2.0 / 3.0, 1.0: 2.0 / 3.0, 2.0: -1.0 / 12.0}
"""Fourth-order central difference: steps from the middle -> weight."""


class Sgp4:
    """States straight from the element sets; what came before does not matter."""

    def propagate(
        self,
        states: NDArray[np.float64],
        t0_s: float,
        knots_s: NDArray[np.float64],
        parameters: PropagationParameters,
    ) -> NDArray[np.float64]:
        """
        Return states at the knots, see `Propagator.propagate`; of *states* only those inside the Earth matter, which stay.

        Positions are SGP4's. SGP4's own velocity leaves out parts of its positions' derivative: it
        is off by 2 cm/s in LEO and by 2 m/s for some sets. Between knots that would put a saw tooth
        of the same size into truth, so velocities are taken from the positions, to about 1e-5 m/s.

        Raises:
            ConfigurationError: There are no element sets, or one cannot be propagated.
        """
        if len(parameters.element_sets) != len(states):
            raise ConfigurationError(
                "parameters.propagator: sgp4 needs an element set for every satellite"
            )
        # Long after its end SGP4 has no states of a satellite.
        flying = np.flatnonzero(~is_inside_earth(states))
        found = np.repeat(states[:, None], len(knots_s), axis=1)
        if len(flying):
            sets = tuple(parameters.element_sets[n] for n in flying.tolist())
            found[flying] = self._flown(sets, parameters.epoch_utc, knots_s)
        return found

    @staticmethod
    def _flown(
        sets: tuple[ElementSet, ...], epoch_utc: datetime, knots_s: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the states of a fleet at the knots, shape (N, K, 6), m and m/s."""
        steps = np.array((0.0, *WEIGHTS)) * DIFFERENCE_S
        # Knots and differences often fall on the same times; each is computed once.
        times_s, place = np.unique(np.round(knots_s + steps[:, None], 9), return_inverse=True)
        found = sgp4_states(sets, epoch_utc, times_s, may_fall=True)[..., :3]
        r, *around = (found[:, row] for row in place.reshape(len(steps), -1))
        v = sum(weight * near for weight, near in zip(WEIGHTS.values(), around, strict=True))
        return np.concatenate((r, np.asarray(v) / DIFFERENCE_S), axis=2)


@lru_cache(maxsize=64)
def _fleet_records(element_sets: tuple[ElementSet, ...]) -> SatrecArray:
    """Cached, since a worker gets the same parts of the fleet with every window."""
    return SatrecArray([to_satrec(element_set) for element_set in element_sets])


def sgp4_states(
    element_sets: tuple[ElementSet, ...],
    epoch_utc: datetime,
    t_s: NDArray[np.float64],
    *,
    may_fall: bool = False,
) -> NDArray[np.float64]:
    """
    Return the states of a fleet by SGP4.

    Args:
        element_sets: N sets.
        epoch_utc: UTC of t_s = 0.
        t_s: Times, shape (K,), s.
        may_fall: Whether satellites may be lower than the Earth's equator is; of one that has been inside the Earth by then,
            the first position there stands for those that SGP4 does not have any more.

    Returns:
        States, shape (N, K, 6), m and m/s, TEME.

    Raises:
        ConfigurationError: A set cannot be propagated to a time; names the satellites, when first, and why.

    Accuracy: within 1.2e-7 km of the verification vectors that the sgp4 package ships.
    """
    whole, part = julian_date(epoch_utc)
    # Whole days stay apart from the rest, which would lose digits beside them.
    days, rest_s = np.divmod(np.asarray(t_s, dtype=np.float64), SECONDS_PER_DAY)
    errors, r_km, v_km_s = _fleet_records(element_sets).sgp4(
        whole + days, part + rest_s / SECONDS_PER_DAY
    )
    if may_fall and errors.any():
        errors = np.where(errors == DECAYED, 0, errors)
        is_inside = (errors == 0) & is_inside_earth(r_km * 1000.0)
        is_over = (errors > 0) & np.logical_or.accumulate(is_inside, axis=1)
        for n in np.flatnonzero(is_over.any(axis=1)).tolist():
            r_km[n, is_over[n]] = r_km[n, int(np.argmax(is_inside[n]))]
            v_km_s[n, is_over[n]] = 0.0
        errors[is_over] = 0
    faults = []
    for n in np.flatnonzero(errors.any(axis=1)).tolist():
        k = int(np.argmax(errors[n] > 0))
        why = SGP4_ERRORS.get(int(errors[n, k]), str(errors[n, k]))
        faults.append(f"{element_sets[n].name}: SGP4: {why}, at {t_s[k]:g} s")
    if faults:
        raise ConfigurationError("\n".join(faults))
    return np.concatenate((r_km, v_km_s), axis=2) * 1000.0
