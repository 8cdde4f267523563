"""SGP4 as a propagator of whole fleets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.sgp4_sets import sgp4_states


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

        Raises:
            ConfigurationError: There are no element sets, or one cannot be propagated.
        """
        if len(parameters.element_sets) != len(states):
            raise ConfigurationError(
                "parameters.propagator: sgp4 needs an element set for every satellite"
            )
        return sgp4_states(parameters.element_sets, parameters.epoch_utc, knots_s)
