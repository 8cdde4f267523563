"""Flight software that burns at the same time as all others: the worst that 2.8 and 2.10 of a plan ask about."""

from __future__ import annotations

import math

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Readings,
)

RADIAL_M_S = 0.1


class Together(FlightSoftware):
    """Commands a radial burn at `commanded_s` of flight.settings, to begin `lead_s` later, and again each `every_s`, if given."""

    def setup(self, context: FlightContext) -> None:
        """Nothing is commanded yet."""
        self._context, self._settings = context, context.settings
        self._due_s = float(self._settings["commanded_s"])

    def step(self, t_s: float, readings: Readings) -> None:
        """Command when it is time."""
        if t_s < self._due_s:
            return
        self._due_s += float(self._settings.get("every_s", math.inf))
        at_s = t_s + float(self._settings["lead_s"])
        self._context.delta_v((RADIAL_M_S, 0.0, 0.0), at_s=at_s, frame="rtn")
