"""
The health of the model: what an exact propagation would keep, recorded for every vehicle and window.

A maneuver changes what is kept, so the reference is taken anew after each; while a vehicle burns, and
where drag acts, nothing is judged.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from madns_runtime.plugin.api import HostContext
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.hosting.supply import TruthSupply
from madns_runtime.simulations.constellation.orbit.invariants import ENERGY, MOMENTUM, MOMENTUM_Z

INVARIANTS = (
    Field("t_s", "s"),
    Field("agent", "", "str"),
    Field("energy_j_kg", "J/kg"),
    Field("momentum_m2_s", "m^2/s"),
    Field("momentum_z_m2_s", "m^2/s"),
    Field("energy_drift", "1"),
    Field("momentum_z_drift", "1"),
)
"""One record a vehicle and window; drifts are relative to simulated time zero or to the end of the last
maneuver, and missing where there is none in the window to compare with."""


class Conservation:
    """
    Compares each window with a reference of its vehicle.

    Args:
        context: Where records go.
        supply: Where truth is.
        reference: Of the epoch, shape (N, 3), see `orbit.invariants`.
    """

    def __init__(
        self, context: HostContext, supply: TruthSupply, reference: NDArray[np.float64]
    ) -> None:
        self.energy_drift = 0.0
        self.energy_drift_agent = ""
        self.momentum_z_drift = 0.0
        self._context = context
        self._supply = supply
        self._reference: list[NDArray[np.float64] | None] = list(reference)
        self._since_s = [0.0] * len(reference)
        context.open_stream("invariants", INVARIANTS)

    def record(self, vehicle: int, window: int) -> None:
        """Record what the window's last knot conserves; the worst knot counts for the summary."""
        store = self._supply.store
        if window < store.oldest:
            return
        values = store.invariants(vehicle, window)
        first = self._first_judged(vehicle, window, len(values))
        drifts: tuple[float | None, float | None] = (None, None)
        if first < len(values):
            drifts = self._judge(vehicle, values[first:])
        energy, momentum, momentum_z = values[-1].tolist()
        end_s = (window + 1) * store.window_s
        agent = self._context.agents[vehicle]
        self._context.record("invariants", (end_s, agent, energy, momentum, momentum_z, *drifts))

    def _first_judged(self, vehicle: int, window: int, knots: int) -> int:
        """Return the first knot of the window that is compared; renews the reference after a maneuver."""
        store = self._supply.store
        start_s, end_s = window * store.window_s, (window + 1) * store.window_s
        ends_s = [
            effect.end_s
            for effect in self._supply.timelines[vehicle].effects
            if effect.kind in ("impulse", "thrust") and effect.start_s <= end_s
        ]
        if ends_s and max(ends_s) > self._since_s[vehicle]:
            self._since_s[vehicle] = max(ends_s)
            self._reference[vehicle] = None
        first = max(0, math.ceil((self._since_s[vehicle] - start_s) / store.knot_s - 1e-9))
        if self._reference[vehicle] is None and first < knots:
            self._reference[vehicle] = store.invariants(vehicle, window)[first].copy()
        return first

    def _judge(
        self, vehicle: int, values: NDArray[np.float64]
    ) -> tuple[float, float] | tuple[None, None]:
        """Return the drifts of energy and momentum at the last knot, relative to the reference."""
        # Who has met the Earth stands still and keeps nothing.
        values = values[values[:, MOMENTUM] > 0.0]
        if not len(values):
            return None, None
        reference = self._reference[vehicle]
        assert reference is not None
        deviation = values - reference
        energy_drift = deviation[:, ENERGY] / abs(reference[ENERGY])
        # Relative to the whole momentum: a polar orbit's z component is next to nothing.
        momentum_drift = deviation[:, MOMENTUM_Z] / reference[MOMENTUM]
        worst = float(np.abs(energy_drift).max())
        if worst > self.energy_drift:
            self.energy_drift = worst
            self.energy_drift_agent = self._context.agents[vehicle]
        self.momentum_z_drift = max(self.momentum_z_drift, float(np.abs(momentum_drift).max()))
        return float(energy_drift[-1]), float(momentum_drift[-1])
