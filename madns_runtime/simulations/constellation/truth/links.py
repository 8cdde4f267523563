"""
Crosslinks: radio between vehicles, with the host as the medium.

Pure: states come from a function, times from messages. What becomes of a message depends on the truth
at the time it was sent, on what its sender sent before, and on the seed; never on when, or in which
order, the host hears of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.messages import Delivery, Transmission
from madns_runtime.simulations.constellation.parameters import Crosslinks as CrosslinkSettings
from madns_runtime.simulations.constellation.truth.medium import LINK_FIELDS, LinkEvent

__all__ = ["LINK_FIELDS", "Crosslinks", "LinkEvent", "States"]

States = Callable[[float], NDArray[np.float64] | None]
"""Truth of all vehicles at a time: shape (N, 6), m and m/s, TEME; None if it is not known (any more)."""


class Crosslinks:
    """The medium between vehicles."""

    def __init__(
        self,
        settings: CrosslinkSettings,
        *,
        agents: tuple[str, ...],
        satellites: tuple[str, ...],
        random: np.random.Generator,
        states: States,
    ) -> None:
        raise NotImplementedError

    def send(self, sender: int, transmission: Transmission, now_s: float) -> list[LinkEvent]:
        """Send a vehicle's message and return what becomes of it, one event a receiver."""
        raise NotImplementedError

    def due(self, t_s: float) -> list[tuple[int, Delivery]]:
        """Return receivers and what they hear soon after *t_s*; each once."""
        raise NotImplementedError

    def next_s(self) -> float | None:
        """Return when `due` has something next; None: nothing is on its way."""
        raise NotImplementedError

    def summary(self) -> Mapping[str, int]:
        """Return the account."""
        raise NotImplementedError
