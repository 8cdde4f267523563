"""Guidance that does nothing, as in the thesis's satellite runs (section 6.2): it takes every state and answers none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Readings,
)


class NullGuidance(FlightSoftware):
    """A satellite that coasts."""

    def setup(self, context: FlightContext) -> None:
        """Begin to count."""
        self._states = 0

    def step(self, t_s: float, readings: Readings) -> None:
        """Count the state, and command nothing."""
        self._states += bool(readings)

    def finish(self) -> Mapping[str, Any]:
        """Return how many states it was given."""
        return {"states": self._states}
