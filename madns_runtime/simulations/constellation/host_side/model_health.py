"""
The health of the model: what an exact propagation would keep, and whether knots lie near enough for bodies that turn.

What is conserved is recorded for every vehicle and window. A maneuver changes it, so the reference is taken anew
after each; while a vehicle burns, and where drag acts, nothing is judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.plugin.api import HostContext
from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.orbit.interpolation import knot_error_rad
from madns_runtime.simulations.constellation.orbit.invariants import ENERGY, MOMENTUM, MOMENTUM_Z
from madns_runtime.simulations.constellation.streams import INVARIANTS
from madns_runtime.simulations.constellation.truth.segments import TruthStore

CHECK = "constellation.attitude_error_rad"
SHORTER_BY_MIN = 0.01


class Conservation:
    """
    Compares each window with a reference of its vehicle.

    Args:
        context: Where records go.
        store: Where truth is.
        reference: Of the epoch, shape (N, 3), see `orbit.invariants`.
    """

    def __init__(
        self, context: HostContext, store: TruthStore, reference: NDArray[np.float64]
    ) -> None:
        self.energy_drift = 0.0
        self.energy_drift_agent = ""
        self.momentum_z_drift = 0.0
        self._context = context
        self._store = store
        self._reference: list[NDArray[np.float64] | None] = list(reference)
        self._since_s = [0.0] * len(reference)
        context.open_stream("invariants", INVARIANTS)

    def record(self, vehicle: int, window: int) -> None:
        """Record what the window's last knot conserves; the worst knot counts for the summary."""
        store = self._store
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

    def forget(self, vehicle: int) -> None:
        """Compare with the next window's first knot from now on: what was a reference may have been burnt away."""
        self._reference[vehicle] = None

    def _first_judged(self, vehicle: int, window: int, knots: int) -> int:
        """Return the first knot of the window that is compared; renews the reference after a maneuver."""
        store = self._store
        start_s, end_s = window * store.window_s, (window + 1) * store.window_s
        ends_s = [
            effect.end_s
            for effect in self._store.timelines[vehicle].effects
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
        worst = math.inf if math.isnan(worst) else worst  # which no comparison would find
        if worst > self.energy_drift:
            self.energy_drift = worst
            self.energy_drift_agent = self._context.agents[vehicle]
        self.momentum_z_drift = max(self.momentum_z_drift, float(np.abs(momentum_drift).max()))
        return float(energy_drift[-1]), float(momentum_drift[-1])


class AttitudeSpacing:
    """
    Looks at what is handed out of rigid bodies.

    Args:
        context: Where it is told.
        limit_rad: What may be.
        knot_s: Time between knots of the scenario, s.
    """

    def __init__(self, context: HostContext, *, limit_rad: float, knot_s: float) -> None:
        self.error_rad_max = 0.0
        self.agent = ""
        """Agent of the vehicle."""
        self._context = context
        self._limit_rad = limit_rad
        self._knot_s = knot_s
        self._told: set[int] = set()

    def look(self, vehicle: int, segments: Sequence[Segment]) -> None:
        """Note how far attitude between a vehicle's knots is off; its first excess is told."""
        for segment in segments:
            if segment.attitude is None:
                continue
            error_rad = knot_error_rad(segment.attitude.tolist(), segment.knot_s)
            if error_rad > self.error_rad_max:
                self.error_rad_max, self.agent = error_rad, self._context.agents[vehicle]
            if error_rad > self._limit_rad and vehicle not in self._told:
                self._told.add(vehicle)
                self._tell(vehicle, segment.t0_s, error_rad)

    def finish(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """Return the summary's values and what is judged."""
        got = self.error_rad_max
        values = {"attitude_error_rad_max": got, "attitude_error_agent": self.agent}
        passed = got <= self._limit_rad
        return values, [{"name": CHECK, "limit": self._limit_rad, "got": got, "passed": passed}]

    def _tell(self, vehicle: int, t_s: float, error_rad: float) -> None:
        # The error goes as the fourth power of the knots' distance.
        share = max(SHORTER_BY_MIN, (self._limit_rad / error_rad) ** 0.25)
        digits = -math.floor(math.log10(self._knot_s * share))
        knot_s = math.floor(self._knot_s * share * 10**digits) / 10**digits
        self._context.log(
            "warning",
            f"{self._context.agents[vehicle]} turns so fast that its attitude between knots is off by about "
            f"{error_rad:.1g} rad from {t_s:g} s on; segments.knot_s: {knot_s:g} follows it",
        )
