"""
Record of slot errors by truth, while a run goes on: what expectations of a constellation under control are judged by.

The slots are those that `analysis.slots` judges afterwards: equal spacing of all agents in their order, whatever the
common phase. Counted are the satellites that fly software with such slots and whose agents live: who is lost
leaves the record, and who comes back is in it again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from madns_runtime.plugin.api import HostContext
from madns_runtime.simulations.constellation.analysis.slots import even_errors_deg
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.mean_elements import mean_from_state
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.streams import SLOT_ERRORS, SLOTS
from madns_runtime.simulations.constellation.truth.segments import TruthStore
from madns_runtime.simulations.constellation.vehicles import flight_of, rules_with_even_slots


class SlotErrors:
    """
    Slot errors of all vehicles, recorded at equal times.

    Args:
        context: Where records go.
        parameters: The scenario's, with record.slots_hz.
        store: Where the vehicles are.
        satellites: What the agents fly.
    """

    def __init__(
        self,
        context: HostContext,
        parameters: ConstellationParameters,
        store: TruthStore,
        satellites: Sequence[str],
    ) -> None:
        rate_hz = parameters.record.slots_hz
        rules = rules_with_even_slots(parameters)
        assert rate_hz is not None and rules
        self._context, self._store = context, store
        self._period_s = 1.0 / rate_hz
        self._gravity = GRAVITY_MODELS[parameters.gravity]
        spacing_deg = rules[0].settings.get("spacing_deg")
        self._spacing_deg = float(spacing_deg) if isinstance(spacing_deg, int | float) else None
        pairs = zip(context.agents, satellites, strict=True)
        self._keeps = np.array([flight_of(parameters, *pair) in rules for pair in pairs])
        self._lives = np.ones(len(context.agents), dtype=np.bool_)
        self._next = 0
        context.open_stream("slots", SLOTS)
        context.open_stream("slot_errors", SLOT_ERRORS)

    def timer(self, t_s: float) -> float | None:
        """Record what is due, and return when to come back; nothing more once truth has ended."""
        due_s = self._next * self._period_s
        if due_s > self._context.duration_s:
            return None
        if t_s >= due_s:
            self._record(due_s)
            # Whoever comes late, as after a long step, does not make up for it.
            self._next = math.floor(t_s / self._period_s + 1e-9) + 1
        return self._next * self._period_s

    def leave_out(self, vehicles: Iterable[int]) -> None:
        """Count all vehicles from now on but these."""
        self._lives[:] = True
        self._lives[list(vehicles)] = False

    def _record(self, t_s: float) -> None:
        states = self._store.states(t_s)
        if states is None:
            return
        mean = np.full((len(states), 1, 5), np.nan)
        for vehicle in np.flatnonzero(self._keeps & self._lives).tolist():
            x, y, z, vx, vy, vz = states[vehicle].tolist()
            try:
                mean[vehicle, 0, 0] = mean_from_state(
                    (x, y, z), (vx, vy, vz), self._gravity
                ).lam_rad
            except ValueError:
                continue  # no ellipse, or in the equator: it has no place in a ring
        errors_deg = even_errors_deg(mean, spacing_deg=self._spacing_deg)[:, 0]
        counted = np.flatnonzero(np.isfinite(errors_deg))
        agents, found = self._context.agents, errors_deg[counted]
        for vehicle, error_deg in zip(counted.tolist(), found.tolist(), strict=True):
            self._context.record("slot_errors", (t_s, agents[vehicle], error_deg))
        if not len(counted):
            self._context.record("slots", (t_s, 0, None, None, None))
            return
        worst = int(np.argmax(np.abs(found)))
        rms_deg, largest_deg = float(np.sqrt(np.mean(found**2))), abs(float(found[worst]))
        row = (t_s, len(counted), rms_deg, largest_deg, agents[counted[worst]])
        self._context.record("slots", row)
