"""
The truth of one vehicle that is commanded: propagated from change to change. Runs in the loop and in the executor.

Between two changes nothing but the forces acts, so each interval is one call of the scenario's propagator;
its knots are those of the grid and of the pieces that the interval needs besides.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.frames import vector_to_inertial
from madns_runtime.simulations.constellation.thrust import Thrust, Vector
from madns_runtime.simulations.constellation.truth.maneuvers.effects import (
    TURNING,
    Effect,
    KnotSpan,
    Piece,
    VehicleTruth,
    knot_at_or_after,
    lay_out,
    scaled,
    spin_rad_s_max,
    total,
)
from madns_runtime.simulations.constellation.truth.orbit_curves import OrbitCurve
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    conserved_by,
    is_inside_earth,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody

Array = NDArray[np.float64]
ROUNDING_S = 1e-9
"""Knots nearer to each other than this are the same, computed on two ways."""
COASTING: Vector = (0.0, 0.0, 0.0)
THRUST_LEG_S = 10.0
"""Most of a thrust arc that is propagated in one call."""


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
    thrusts: dict[int, Thrust] = field(default_factory=dict)
    """Of those thrust arcs that began by start_s, by the effect's number."""
    ballistic_m2_kg: float = 0.0
    """At start_s."""
    body: RigidBody | None = None
    """At start_s; None for a point mass."""
    orbit: OrbitCurve | None = None
    """Of all the time from start_s on, where it is known and no effect changes it; None to propagate it."""


def propagate_vehicle(request: VehicleRequest, parameters: PropagationParameters) -> VehicleTruth:
    """
    Return one vehicle's truth from a change on.

    Args:
        request: What is wanted.
        parameters: Settings and constants; names has this vehicle's, what else is one per vehicle is the
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
    rows = _engine("attitude").propagate_attitude(
        bodies, states, t0_s=float(knots_s[0]), knots_s=knots_s, parameters=parameters
    )
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
        # An actuator does one thing at a time.
        self._thrust: Thrust | None = None
        self._torque = self._dipole = COASTING
        # By attitude in plain numbers; what nobody magnetises keeps its digits.
        self._is_magnetic = any(effect.kind == "dipole" for effect in request.effects)
        self._thrusts: dict[int, Thrust] = {}
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
        spans: list[KnotSpan] = []
        if t0_s >= request.change_s:
            is_turned = self._torque != COASTING or self._dipole != COASTING
            is_arc = self._thrust is not None or is_turned
            # Impulses change the velocity there; what drag acts on is one number in a segment.
            kinds = {e.kind for e in request.effects if e.start_s == stop_s}
            jumps = not kinds.isdisjoint(("impulse", "ballistic"))
            spans = lay_out(t0_s, stop_s, request.knot_s, jumps=jumps, is_arc=is_arc)
        else:
            knots = []
        wanted = {stop_s, *(knot * request.knot_s for knot in knots)}
        for span in spans:
            wanted.update(span.times_s())
        at, last = self._states_at(wanted)
        for span in spans:
            self._add_piece(span, np.stack([at[t] for t in span.times_s()]))
        for knot in knots:
            self._grid[knot - self._first_knot] = at[knot * request.knot_s]
        self._body = self._body_at(stop_s)
        self._state, self._t_s = last, stop_s

    def apply(self, t_s: float) -> None:
        """Let begin and end what does so at *t_s*."""
        for effect in self._request.effects:
            if effect.is_arc and effect.end_s == t_s:
                self._end(effect)
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
            thrusts=self._thrusts,
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
            self._torque = effect.vector
            return
        if effect.kind == "dipole":
            self._dipole = effect.vector
            return
        thrust = self._request.thrusts.get(effect.number)
        if thrust is None or effect.start_s > self._request.start_s:
            change = self._change_of_velocity(effect)
            thrust = Thrust.of(change, effect.start_s, effect.end_s, effect.burnt)
        self._thrust = self._thrusts[effect.number] = thrust

    def _end(self, effect: Effect) -> None:
        if effect.kind == "torque":
            self._torque = COASTING
        elif effect.kind == "dipole":
            self._dipole = COASTING
        else:
            self._thrust = None

    def _change_of_velocity(self, effect: Effect) -> Vector:
        """Return an arc's change of velocity, inertial, m/s: its frame is that of its middle."""
        if effect.frame == "inertial" or effect.at_s <= self._t_s:
            return self._inertial(effect, self._state)
        # Without the arc's own thrust: the frame that guidance, too, could foresee.
        return self._inertial(effect, self._coasted(effect.at_s))

    def _coasted(self, until_s: float) -> Array:
        """Return the state at a later time without thrust; torques and dipoles begin and end on the way."""
        ahead, effects = copy(self), self._request.effects
        edges_s = {t_s for e in effects if e.kind in TURNING for t_s in (e.start_s, e.end_s)}
        for stop_s in sorted({until_s, *(t_s for t_s in edges_s if self._t_s < t_s < until_s)}):
            acting = [e for e in effects if e.start_s <= ahead._t_s < e.end_s]
            ahead._torque, ahead._dipole = (
                next((e.vector for e in acting if e.kind == kind), COASTING) for kind in TURNING
            )
            ahead._state = ahead._leg(ahead._state, ahead._t_s, [stop_s], None)[-1]
            ahead._body, ahead._t_s = ahead._body_at(stop_s), stop_s
        return ahead._state

    @staticmethod
    def _inertial(effect: Effect, state: Array) -> Vector:
        if is_inside_earth(state[:6]):
            return COASTING  # who has met the Earth stands still, and has no plane of motion
        attitude = state[6:10].tolist() if len(state) > 6 else None
        r, v = state[:3].tolist(), state[3:6].tolist()
        return vector_to_inertial(effect.vector, effect.frame, r, v, attitude)

    def _states_at(self, wanted: set[float]) -> tuple[dict[float, Array], Array]:
        """Return states at the wanted times, and at the last of them; times may differ by rounding only."""
        times_s: list[float] = []
        places: dict[float, int] = {}
        for t_s in sorted(wanted):
            if t_s > self._t_s and (not times_s or t_s - times_s[-1] > ROUNDING_S):
                times_s.append(t_s)
            places[t_s] = len(times_s)
        rows = self._flown(times_s)
        known = (self._state, *rows)
        return {t_s: known[place] for t_s, place in places.items()}, rows[-1]

    def _flown(self, times_s: Sequence[float]) -> Array:
        """
        Return states at times after the present one, shape (K, 6 or 13).

        A propagator knows one acceleration a call: an arc is flown in legs, each along a parabola near its
        way, and what the rocket equation gives besides is added to the states.
        """
        thrust = self._thrust
        if thrust is None:
            return self._leg(self._state, self._t_s, times_s, None)
        legs = math.ceil((times_s[-1] - self._t_s) / THRUST_LEG_S)
        edges_s = np.linspace(self._t_s, times_s[-1], legs + 1).tolist()
        state, flown = self._state.copy(), []
        unit = np.array(thrust.acceleration_m_s2)
        for from_s, until_s in pairwise(edges_s):
            inside = [t_s for t_s in times_s if from_s < t_s <= until_s]
            stops_s = inside if until_s in inside else [*inside, until_s]
            lead_s, push = thrust.parabola(from_s, until_s)
            state[3:6] += lead_s * unit
            rows = self._leg(state, from_s, stops_s, scaled(thrust.acceleration_m_s2, push))
            for row, t_s in zip(rows, stops_s, strict=True):
                velocity_s, way_s2 = thrust.gains(from_s, t_s)
                tau_s = t_s - from_s
                row[:3] += (way_s2 - (lead_s + push * tau_s / 2.0) * tau_s) * unit
                row[3:6] += (velocity_s - lead_s - push * tau_s) * unit
            flown += list(rows[: len(inside)])
            state = rows[-1].copy()
        return np.stack(flown)

    def _leg(
        self, state: Array, from_s: float, times_s: Sequence[float], thrust_m_s2: Vector | None
    ) -> Array:
        """Return states at times after *from_s* under one thrust and the present torque, shape (K, 6 or 13)."""
        parameters = replace(
            self._parameters,
            ballistic_m2_kg=np.array([self._ballistic]),
            thrust_m_s2=None if thrust_m_s2 is None else np.array([thrust_m_s2]),
        )
        knots, states = np.array(times_s), state[None]
        body = self._body_at(from_s)
        if body is not None and self._is_magnetic:
            rows = self._turned_by_field(body, states, from_s, knots, parameters)
        elif body is not None:
            propagate_attitude = _engine("attitude").propagate_attitude
            rows = propagate_attitude(
                [body], states, t0_s=from_s, knots_s=knots, parameters=parameters
            )
        else:
            rows = propagate(states, from_s, knots, parameters)
        vehicle: Array = rows[0]
        self._check_spin(vehicle)
        return vehicle

    def _turned_by_field(
        self,
        body: RigidBody,
        states: Array,
        from_s: float,
        knots_s: Array,
        parameters: PropagationParameters,
    ) -> Array:
        """Return the state at times after *from_s*, shape (1, K, 13), along the orbit that is known or propagated."""
        orbit = self._request.orbit
        if orbit is None:
            support_s = _engine("attitude").support_times(from_s, knots_s)
            rows = propagate(states[:, :6], from_s, support_s, parameters)[0]
            orbit = OrbitCurve(support_s, rows)
        times_s = np.concatenate(((from_s,), knots_s))
        turned = _engine("magnetic_turn").turn_by_field(
            body, states[0, 6:], orbit, times_s, parameters
        )
        points = np.array([orbit.state(t_s) for t_s in knots_s.tolist()])
        return np.concatenate((points, turned), axis=1)[None]

    def _body_at(self, t_s: float) -> RigidBody | None:
        """Return the body under the present torque, and what its wheels hold at *t_s*."""
        body = self._body
        if body is None:
            return None
        wheels = body.wheels_n_m_s
        if wheels is not None:
            wheels = total((wheels, scaled(self._torque, self._t_s - t_s)))
        return replace(body, torque_n_m=self._torque, dipole_a_m2=self._dipole, wheels_n_m_s=wheels)

    def _check_spin(self, rows: Array) -> None:
        if self._body is None:
            return
        spin_rad_s = float(np.linalg.norm(rows[:, 10:], axis=1).max())
        limit_rad_s = spin_rad_s_max(self._request.knot_s)
        if not spin_rad_s < limit_rad_s:
            raise ConfigurationError(
                f"{self._parameters.name_of(0)}: expected a body that turns less than half a turn in "
                f"parameters.segments.knot_s, {limit_rad_s:.4g} rad/s, got {spin_rad_s:.4g} rad/s"
            )

    def _add_piece(self, span: KnotSpan, rows: Array) -> None:
        self._pieces.append(
            Piece(
                t0_s=span.start_s,
                knot_s=span.knot_s,
                states=np.ascontiguousarray(rows[:, :6]),
                end_s=span.end_s,
                attitude=np.ascontiguousarray(rows[:, 6:]) if self._body is not None else None,
                thrust=self._thrust,
            )
        )


def _engine(name: str) -> ModuleType:
    """Return a module of the propagators that needs scipy, imported when it is first used."""
    return importlib.import_module(
        f"madns_runtime.simulations.constellation.truth.propagators.{name}"
    )
