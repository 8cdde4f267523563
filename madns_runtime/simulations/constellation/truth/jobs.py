"""
The truth of one vehicle that is commanded: propagated from change to change. Runs in the loop and in the executor.

Between two changes nothing but the forces acts, so each interval is one call of the scenario's propagator;
its knots are those of the grid and of the pieces that the interval needs besides.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.frames import vector_to_inertial
from madns_runtime.simulations.constellation.truth.effects import Effect, Vector, scaled, total
from madns_runtime.simulations.constellation.truth.pieces import (
    Piece,
    Span,
    VehicleTruth,
    knot_at_or_after,
    lay_out,
)
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    conserved_by,
    propagate,
)

if TYPE_CHECKING:
    # It imports scipy, which hosts of point masses may do without.
    from madns_runtime.simulations.constellation.truth.attitude import RigidBody

Array = NDArray[np.float64]
ROUNDING_S = 1e-9
"""Knots nearer to each other than this are the same, computed on two ways."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleRequest:
    """From where to propagate one vehicle, until when, and what is done to it on the way."""

    start_s: float
    state: Array
    """At start_s, with all in it that acts once at start_s: shape (6,), or (13,) for a rigid body."""
    change_s: float
    """From when on truth is wanted, not before start_s."""
    end_knot: int
    """The last knot of the grid that is wanted, not before change_s."""
    knot_s: float
    effects: tuple[Effect, ...] = ()
    """In order: what acts at start_s or begins after it."""
    directions: dict[int, Vector] = field(default_factory=dict)
    """Accelerations of those thrust arcs that began by start_s, m/s^2, inertial, by the effect's number."""
    ballistic_m2_kg: float = 0.0
    """At start_s."""
    body: RigidBody | None = None
    """At start_s; None for a point mass."""


def propagate_vehicle(request: VehicleRequest, parameters: PropagationParameters) -> VehicleTruth:
    """
    Return one vehicle's truth from a change on.

    Args:
        request: What is wanted.
        parameters: Settings and constants; names has this vehicle's, what else is one a vehicle is the
            request's.

    Raises:
        ConfigurationError: It cannot be propagated.
    """
    flight = _Flight(request, parameters)
    end_s = request.end_knot * request.knot_s
    breaks = {request.change_s, end_s}
    for effect in request.effects:
        breaks |= {effect.start_s, effect.end_s}
    for stop_s in sorted(t for t in breaks if request.start_s < t <= end_s):
        flight.advance(stop_s)
        flight.apply(stop_s)
    return flight.truth()


def propagate_vehicles(
    requests: Sequence[VehicleRequest], parameters: Sequence[PropagationParameters]
) -> list[VehicleTruth]:
    """Do several, in the executor."""
    return [propagate_vehicle(*both) for both in zip(requests, parameters, strict=True)]


def propagate_bodies(
    bodies: Sequence[RigidBody], states: Array, knots_s: Array, parameters: PropagationParameters
) -> Array:
    """Return attitude and rates of rigid bodies that nobody turns, shape (M, K, 7), from (M, 13) at the first knot."""
    torques = np.zeros((len(bodies), 3))
    start_s = float(knots_s[0])
    propagate_attitude = _attitude_module().propagate_attitude
    rows = propagate_attitude(bodies, states, start_s, knots_s, parameters, torques)
    return np.asarray(rows[..., 6:], dtype=np.float64)


class _Flight:
    """One vehicle on its way through a request."""

    def __init__(self, request: VehicleRequest, parameters: PropagationParameters) -> None:
        self._request = request
        self._parameters = replace(parameters, element_sets=(), thrust_m_s2=None)
        self._t_s = request.start_s
        self._state = np.asarray(request.state, dtype=np.float64)
        self._body = request.body
        self._ballistic = request.ballistic_m2_kg
        self._thrusts: dict[int, Vector] = {}
        self._torques: dict[int, Vector] = {}
        self._directions: dict[int, Vector] = {}
        self._pieces: list[Piece] = []
        self._first_knot = knot_at_or_after(request.change_s, request.knot_s)
        count = max(0, request.end_knot - self._first_knot + 1)
        self._grid = np.zeros((count, len(self._state)))
        for effect in request.effects:
            if effect.is_arc and effect.start_s <= request.start_s < effect.end_s:
                self._begin(effect)
        self._put(request.start_s)

    def advance(self, stop_s: float) -> None:
        """Fly to *stop_s*, where the next change is."""
        request, t0_s = self._request, self._t_s
        knots = self._grid_knots(t0_s, stop_s)
        spans: list[Span] = []
        if t0_s >= request.change_s:
            is_arc = bool(self._thrusts or self._torques)
            jumps = any(e.kind == "impulse" and e.start_s == stop_s for e in request.effects)
            spans = lay_out(t0_s, stop_s, request.knot_s, jumps=jumps, is_arc=is_arc)
        else:
            knots = []
        wanted = {stop_s, *(knot * request.knot_s for knot in knots)}
        for span in spans:
            wanted.update(span.times_s())
        torque = total(self._torques.values())
        at, last = self._states_at(wanted, torque)
        for span in spans:
            self._add_piece(span, np.stack([at[t] for t in span.times_s()]))
        for knot in knots:
            self._grid[knot - self._first_knot] = at[knot * request.knot_s]
        self._state, self._t_s = last, stop_s
        if self._body is not None and self._body.wheels_n_m_s is not None:
            taken = total((self._body.wheels_n_m_s, scaled(torque, t0_s - stop_s)))
            self._body = replace(self._body, wheels_n_m_s=taken)

    def apply(self, t_s: float) -> None:
        """Let begin and end what does so at *t_s*."""
        for effect in self._request.effects:
            if effect.is_arc and effect.end_s == t_s:
                self._thrusts.pop(effect.number, None)
                self._torques.pop(effect.number, None)
            if effect.start_s != t_s or effect.start_s <= self._request.start_s:
                continue
            if effect.is_arc:
                self._begin(effect)
            elif effect.kind == "impulse":
                self._state = self._state.copy()
                self._state[3:6] += self._inertial(effect, self._state)
            elif effect.kind == "ballistic":
                self._ballistic = effect.vector[0]
        self._put(t_s)

    def truth(self) -> VehicleTruth:
        """Return what was flown."""
        is_rigid = self._body is not None
        return VehicleTruth(
            change_s=self._request.change_s,
            pieces=tuple(self._pieces),
            first_knot=self._first_knot,
            states=self._grid[:, :6].copy(),
            attitude=self._grid[:, 6:].copy() if is_rigid else None,
            invariants=conserved_by(self._grid[:, :6], self._parameters),
            directions=self._directions,
        )

    def _grid_knots(self, t0_s: float, stop_s: float) -> list[int]:
        """Return the wanted knots of the grid after t0_s and up to *stop_s*."""
        knot_s = self._request.knot_s
        last = knot_at_or_after(stop_s, knot_s)
        knots = range(max(self._first_knot, knot_at_or_after(t0_s, knot_s)), last + 1)
        return [k for k in knots if t0_s < k * knot_s <= stop_s and k <= self._request.end_knot]

    def _put(self, t_s: float) -> None:
        """Write the state into the grid if *t_s* is one of its knots: after what changed there."""
        knot = knot_at_or_after(t_s, self._request.knot_s)
        place = knot - self._first_knot
        if knot * self._request.knot_s == t_s and 0 <= place < len(self._grid):
            self._grid[place] = self._state

    def _begin(self, effect: Effect) -> None:
        if effect.kind == "torque":
            self._torques[effect.number] = effect.vector
            return
        known = self._request.directions.get(effect.number)
        if known is None or effect.start_s > self._request.start_s:
            known = scaled(self._direction(effect), 1.0 / (effect.end_s - effect.start_s))
        self._directions[effect.number] = self._thrusts[effect.number] = known

    def _direction(self, effect: Effect) -> Vector:
        """Return an arc's change of velocity, inertial, m/s: its frame is that of its middle."""
        if effect.frame == "inertial" or effect.at_s <= self._t_s:
            return self._inertial(effect, self._state)
        # Without the arc's own thrust: the frame that guidance, too, could foresee.
        row = self._propagate([effect.at_s], total(self._torques.values()))[-1]
        return self._inertial(effect, row)

    @staticmethod
    def _inertial(effect: Effect, state: Array) -> Vector:
        attitude = state[6:10].tolist() if len(state) > 6 else None
        r, v = state[:3].tolist(), state[3:6].tolist()
        return vector_to_inertial(effect.vector, effect.frame, r, v, attitude)

    def _states_at(self, wanted: set[float], torque: Vector) -> tuple[dict[float, Array], Array]:
        """Return states at the wanted times, and at the last of them; times may differ by rounding only."""
        times_s: list[float] = []
        places: dict[float, int] = {}
        for t_s in sorted(wanted):
            if t_s > self._t_s and (not times_s or t_s - times_s[-1] > ROUNDING_S):
                times_s.append(t_s)
            places[t_s] = len(times_s)
        rows = self._propagate(times_s, torque)
        known = (self._state, *rows)
        return {t_s: known[place] for t_s, place in places.items()}, rows[-1]

    def _propagate(self, times_s: Sequence[float], torque: Vector) -> Array:
        """Return states at times after the present one, shape (K, 6 or 13)."""
        thrust = np.array([total(self._thrusts.values())]) if self._thrusts else None
        parameters = replace(
            self._parameters,
            ballistic_m2_kg=np.array([self._ballistic]),
            thrust_m_s2=thrust,
        )
        knots = np.array(times_s)
        if self._body is not None:
            torques = np.array([torque])
            states = self._state[None]
            propagate_attitude = _attitude_module().propagate_attitude
            rows = propagate_attitude([self._body], states, self._t_s, knots, parameters, torques)
        else:
            rows = propagate(self._state[None], self._t_s, knots, parameters)
        vehicle: Array = rows[0]
        return vehicle

    def _add_piece(self, span: Span, rows: Array) -> None:
        self._pieces.append(
            Piece(
                t0_s=span.start_s,
                knot_s=span.knot_s,
                states=np.ascontiguousarray(rows[:, :6]),
                end_s=span.end_s,
                attitude=np.ascontiguousarray(rows[:, 6:]) if self._body is not None else None,
                thrust_m_s2=total(self._thrusts.values()) if self._thrusts else None,
            )
        )


def _attitude_module() -> ModuleType:
    return importlib.import_module("madns_runtime.simulations.constellation.truth.attitude")
