"""Flight software that burns once, at the same time as all others: the worst that 2.8 and 2.10 of a plan ask about."""

from __future__ import annotations

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Readings,
)

RADIAL_M_S = 0.1


class Together(FlightSoftware):
    """Commands a radial burn at `commanded_s` of flight.settings, to begin `lead_s` later."""

    def setup(self, context: FlightContext) -> None:
        """Nothing is commanded yet."""
        self._context, self._is_done = context, False

    def step(self, t_s: float, readings: Readings) -> None:
        """Command once."""
        settings = self._context.settings
        if self._is_done or t_s < float(settings["commanded_s"]):
            return
        self._is_done = True
        at_s = t_s + float(settings["lead_s"])
        self._context.delta_v((RADIAL_M_S, 0.0, 0.0), at_s=at_s, frame="rtn")
