"""From a scenario's parameters to a fleet: who flies, from which epoch, in which state."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.elements import state_from_elements
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.truth.element_set import ElementSet
from madns_runtime.simulations.constellation.truth.satellite_selection import choose


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialStates:
    """Satellites at the epoch."""

    names: tuple[str, ...]
    epoch_utc: datetime
    states: NDArray[np.float64]
    """Shape (N, 6), m and m/s, TEME."""
    element_sets: tuple[ElementSet, ...]
    """The sets they came from; empty for patterns and Keplerian elements."""


def load_fleet(
    parameters: ConstellationParameters, count: int, base_directory: Path
) -> InitialStates:
    """
    Return the first *count* satellites with their states at the epoch.

    Element sets are turned from mean elements into states by SGP4; other elements are osculating.

    Raises:
        ConfigurationError: As `choose`; or a set cannot be propagated to the epoch.
    """
    chosen = choose(parameters, count, base_directory)
    if chosen.element_sets:
        # Imported here: only fleets of element sets need sgp4.
        from madns_runtime.simulations.constellation.truth.propagators.sgp4_propagator import (
            sgp4_states,
        )

        states = sgp4_states(chosen.element_sets, chosen.epoch_utc, np.zeros(1))[:, 0, :]
    else:
        mu = GRAVITY_MODELS[parameters.gravity].mu_m3_s2
        rows = [state_from_elements(elements, mu) for elements in chosen.orbits]
        states = np.array([(*r, *v) for r, v in rows])
    return InitialStates(
        names=chosen.names,
        epoch_utc=chosen.epoch_utc,
        states=np.ascontiguousarray(states),
        element_sets=chosen.element_sets,
    )
