"""SGP4 as a propagator of whole fleets, with velocities that are its positions' derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.sgp4_sets import sgp4_states

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
        Return states at the knots, see `Propagator.propagate`; *states* and *t0_s* are not used.

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
        steps = np.array((0.0, *WEIGHTS)) * DIFFERENCE_S
        # Knots and differences often fall on the same times; each is computed once.
        times_s, place = np.unique(np.round(knots_s + steps[:, None], 9), return_inverse=True)
        sets, epoch_utc = parameters.element_sets, parameters.epoch_utc
        found = sgp4_states(sets, epoch_utc, times_s, may_fall=True)[..., :3]
        r, *around = (found[:, row] for row in place.reshape(len(steps), -1))
        v = sum(weight * near for weight, near in zip(WEIGHTS.values(), around, strict=True))
        return np.concatenate((r, np.asarray(v) / DIFFERENCE_S), axis=2)
