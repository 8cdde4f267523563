"""Truth by Basilisk's spacecraft dynamics, for points and for rigid bodies."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.quaternions import from_rotation, multiply
from madns_runtime.simulations.constellation.parameters import BasiliskPropagator
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.basilisk_simulation import (
    BasiliskSimulation,
    Design,
    ForcesAndTorques,
)
from madns_runtime.simulations.constellation.truth.propagators.forces import acceleration_of
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody

Array = NDArray[np.float64]

NS_PER_S = 1_000_000_000
SETS_MAX = 4
"""Sets of simulations kept a thread: those of the last designs asked for."""
DIVISORS_TRIED = 1000
"""Numbers of steps tried for one that divides the time between knots into whole nanoseconds."""


class _Leg(NamedTuple):
    """Knots that are equally far apart."""

    gap_ns: int
    knots: int


class _Kept(threading.local):
    """Simulations of one thread: two must not step the same one."""

    def __init__(self) -> None:
        self.sets: OrderedDict[tuple[Design, int], list[BasiliskSimulation]] = OrderedDict()


class Basilisk:
    """RK4 at a fixed step; simulations are kept between calls, as building them takes longer than a call."""

    def __init__(self) -> None:
        self._kept = _Kept()

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
        return self._fly(states, knots_s - t0_s, parameters)

    def propagate_bodies(
        self,
        bodies: Sequence[RigidBody],
        states: Array,
        *,
        offsets_s: Array,
        parameters: PropagationParameters,
    ) -> Array:
        """Return the states of rigid bodies some time later, see `attitude.BodyPropagator`."""
        for number, body in enumerate(bodies):
            if body.wheels_n_m_s is not None:
                name = parameters.name_of(number)
                raise ConfigurationError(f"{name}: basilisk does rigid bodies without wheels only")
        return self._fly(states, offsets_s, parameters, bodies)

    def _fly(
        self,
        states: Array,
        offsets_s: Array,
        parameters: PropagationParameters,
        bodies: Sequence[RigidBody] = (),
    ) -> Array:
        """Return states some time later, of rigid bodies or, without any, of points."""
        offsets_ns = [round(offset_s * NS_PER_S) for offset_s in offsets_s.tolist()]
        out = np.empty((len(states), len(offsets_ns), states.shape[1]))
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
                out[:, knot:end] = self._advance(
                    _Leg(gap_ns, end - knot), states, parameters, bodies
                )
            states, at_ns, knot = out[:, end - 1], offsets_ns[end - 1], end
        return out

    def _advance(
        self,
        leg: _Leg,
        states: Array,
        parameters: PropagationParameters,
        bodies: Sequence[RigidBody],
    ) -> Array:
        """Return the states at the knots of a leg."""
        settings = parameters.settings
        assert isinstance(settings, BasiliskPropagator)
        step_ns, steps = whole_steps(leg.gap_ns, round(settings.step_s * NS_PER_S))
        design = Design(
            count=len(states),
            step_ns=step_ns,
            knot_ns=step_ns * steps,
            gravity=parameters.gravity,
            has_j2=parameters.has_j2,
            has_thrust=parameters.thrust_m_s2 is not None or bool(bodies),
            inertias_kg_m2=tuple(body.inertia_kg_m2 for body in bodies) or None,
            have_gravity_gradient=tuple(body.has_gravity_gradient for body in bodies),
        )
        size = 1 if settings.simulations == "per_vehicle" else len(states)
        simulations = self._simulations(design, size)
        torques = np.array([body.torque_n_m for body in bodies]) if bodies else None
        pushes = ForcesAndTorques(thrust_m_s2=parameters.thrust_m_s2, torques_n_m=torques)
        rest_s = (leg.gap_ns - design.knot_ns) / NS_PER_S
        if rest_s == 0.0:
            return run_all(simulations, states, leg.knots, pushes)
        parts = []
        for _ in range(leg.knots):
            states = drifted(run_all(simulations, states, 1, pushes)[:, 0], rest_s, parameters)
            parts.append(states)
        return np.stack(parts, axis=1)

    def _simulations(self, design: Design, size: int) -> list[BasiliskSimulation]:
        """Return simulations of *size* vehicles each, in order."""
        kept, key = self._kept.sets, (design, size)
        if key not in kept:
            parts = [slice(first, first + size) for first in range(0, design.count, size)]
            kept[key] = [BasiliskSimulation(design.part(part)) for part in parts]
            if len(kept) > SETS_MAX:
                kept.popitem(last=False)
        kept.move_to_end(key)
        return kept[key]


def run_all(
    simulations: Sequence[BasiliskSimulation], states: Array, knots: int, pushes: ForcesAndTorques
) -> Array:
    """Return the states at the next knots of vehicles that are spread over simulations in order."""
    found, first = [], 0
    for simulation in simulations:
        part = slice(first, first + simulation.count)
        found.append(simulation.run(states[part], knots, pushes.part(part)))
        first = part.stop
    return np.concatenate(found)


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
    """Return states (N, 6 or 13) some microseconds later, by second-order Taylor series; rates stay."""
    r, v = states[:, :3], states[:, 3:6]
    a = acceleration_of(parameters)(r.T, v.T).T
    parts = [r + v * time_s + 0.5 * a * time_s**2, v + a * time_s]
    if states.shape[1] > 6:
        rates = states[:, 10:]
        turns = [from_rotation(turn) for turn in (rates * time_s).tolist()]
        attitudes = zip(states[:, 6:10].tolist(), turns, strict=True)
        parts += [np.array([multiply(q, turn) for q, turn in attitudes]), rates]
    return np.hstack(parts)
