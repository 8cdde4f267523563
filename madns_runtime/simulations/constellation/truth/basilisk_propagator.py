"""Truth by Basilisk's spacecraft dynamics, for points; `basilisk_attitude` is for rigid bodies."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.parameters import BasiliskPropagator
from madns_runtime.simulations.constellation.truth.basilisk_simulation import Design, Simulation
from madns_runtime.simulations.constellation.truth.forces import acceleration_of
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters

Array = NDArray[np.float64]

NS_PER_S = 1_000_000_000
SETS_MAX = 4
"""Sets of simulations kept: those of the last designs asked for."""
DIVISORS_TRIED = 1000
"""Numbers of steps tried for one that divides the time between knots into whole nanoseconds."""


class Basilisk:
    """RK4 at a fixed step; simulations are kept between calls, as building them takes longer than a call."""

    def __init__(self) -> None:
        self._sets: OrderedDict[tuple[Design, int], list[Simulation]] = OrderedDict()

    def propagate(
        self,
        states: Array,
        t0_s: float,
        knots_s: Array,
        parameters: PropagationParameters,
    ) -> Array:
        """
        Return states at the knots, see `Propagator.propagate`.

        Steps are settings.step_s or a little shorter, so that they end on the knots. Basilisk counts
        whole nanoseconds, and so are knots rounded: 4e-6 m in LEO. Accuracy over 4 h at 0.1 s:
        tests/constellation/test_propagator_basilisk.py.
        """
        offsets_ns = [round(offset_s * NS_PER_S) for offset_s in (knots_s - t0_s).tolist()]
        out = np.empty((len(states), len(offsets_ns), 6))
        knot, at_ns = 0, 0
        while knot < len(offsets_ns):
            gap_ns = offsets_ns[knot] - at_ns
            end = knot + 1
            if gap_ns == 0:
                out[:, knot] = states
            else:
                # As many knots at once as are equally far apart.
                while end < len(offsets_ns) and offsets_ns[end] - offsets_ns[end - 1] == gap_ns:
                    end += 1
                out[:, knot:end] = self._advance(states, gap_ns, end - knot, parameters)
            states, at_ns, knot = out[:, end - 1], offsets_ns[end - 1], end
        return out

    def _advance(
        self, states: Array, gap_ns: int, knots: int, parameters: PropagationParameters
    ) -> Array:
        """Return the states at *knots* knots that are *gap_ns* apart."""
        settings = parameters.settings
        assert isinstance(settings, BasiliskPropagator)
        step_ns, steps = whole_steps(gap_ns, round(settings.step_s * NS_PER_S))
        design = Design(
            count=len(states),
            step_ns=step_ns,
            knot_ns=step_ns * steps,
            gravity=parameters.gravity,
            has_j2=parameters.has_j2,
            has_thrust=parameters.thrust_m_s2 is not None,
        )
        rest_s = (gap_ns - design.knot_ns) / NS_PER_S
        if rest_s == 0.0:
            return self._run(design, states, knots, parameters)
        parts = []
        for _ in range(knots):
            states = drifted(self._run(design, states, 1, parameters)[:, 0], rest_s, parameters)
            parts.append(states)
        return np.stack(parts, axis=1)

    def _run(
        self, design: Design, states: Array, knots: int, parameters: PropagationParameters
    ) -> Array:
        settings = parameters.settings
        assert isinstance(settings, BasiliskPropagator)
        apart = settings.simulations == "per_vehicle"
        each = replace(design, count=1) if apart else design
        simulations = self._simulations(each, len(states) if apart else 1)
        per_simulation = each.count
        found = []
        for number, simulation in enumerate(simulations):
            part = slice(number * per_simulation, (number + 1) * per_simulation)
            thrust = None if parameters.thrust_m_s2 is None else parameters.thrust_m_s2[part]
            found.append(simulation.run(states[part], knots, thrust_m_s2=thrust))
        return np.concatenate(found)

    def _simulations(self, design: Design, count: int) -> list[Simulation]:
        key = (design, count)
        if key not in self._sets:
            self._sets[key] = [Simulation(design) for _ in range(count)]
            if len(self._sets) > SETS_MAX:
                self._sets.popitem(last=False)
        self._sets.move_to_end(key)
        return self._sets[key]


def whole_steps(gap_ns: int, step_ns_max: int) -> tuple[int, int]:
    """
    Return a step of whole nanoseconds, not above *step_ns_max*, and how many of it fill *gap_ns*.

    If no number of steps near the least one divides the gap, less than one nanosecond a step is left.
    """
    least = math.ceil(gap_ns / step_ns_max)
    for steps in range(least, min(least + DIVISORS_TRIED, gap_ns) + 1):
        if gap_ns % steps == 0:
            return gap_ns // steps, steps
    return gap_ns // least, least


def drifted(states: Array, time_s: float, parameters: PropagationParameters) -> Array:
    """Return states (N, 6) some microseconds later, by second-order Taylor series."""
    r, v = states[:, :3], states[:, 3:]
    a = acceleration_of(parameters)(r.T, v.T).T
    return np.hstack((r + v * time_s + 0.5 * a * time_s**2, v + a * time_s))
