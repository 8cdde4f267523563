"""
Effects of commands on truth: changes of velocity and of the ballistic coefficient, arcs of thrust, torque and dipole. Pure.

An effect is what an actuator really gives, errors included; its frame is resolved when truth is propagated,
since the directions at that time depend on what was done before.

Truth of a vehicle is kept at the knots of a grid common to all. Where an effect begins or ends between two
knots, or changes the velocity at one, pieces with knots of their own cover the intervals in question, so
that interpolation never spans a jump.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.messages import (
    CommandFrame,
    Segment,
    knot_runs,
)
from madns_runtime.simulations.constellation.thrust import Thrust, Vector

EffectKind = Literal["impulse", "thrust", "torque", "ballistic", "dipole"]

TURNING: tuple[EffectKind, EffectKind] = ("torque", "dipole")
"""Effects that turn a body while they act."""
SNAP_S = 1e-7
"""A time this near to a knot is the knot's: 0.2 mm at 2 km/s."""
SHORT = 0.1
"""Part of a knot's time: a shorter piece is drawn out over the next interval, whose position would else lose
digits when its small steps are divided by a small time."""
ARC_S_MIN = 0.01
"""A burn that is over sooner is an impulse; a torque or a dipole is not given for less, s."""
ARC_INTERVALS_MIN = 4
"""Knots in an arc of thrust, torque or dipole are at least this dense."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """One change of a vehicle's truth."""

    number: int
    """Place among the effects of its vehicle in the order in which they were taken."""
    kind: EffectKind
    at_s: float
    """T_m: when its frame is resolved; the middle of a thrust arc."""
    start_s: float
    """From when truth is another one."""
    end_s: float
    """Until when it acts; start_s for an impulse and for a ballistic coefficient."""
    vector: Vector
    """impulse and thrust: change of velocity, m/s; torque: N m, body; dipole: A m^2, body;
    ballistic: m^2/kg and two zeros."""
    frame: CommandFrame = "inertial"
    burnt: float = 0.0
    """Share of the vehicle's mass that a thrust arc burns."""

    @property
    def is_arc(self) -> bool:
        """Whether it takes time."""
        return self.end_s > self.start_s

    def moved(self, *, start_s: float | None = None, end_s: float | None = None) -> Effect:
        """Return it with another beginning or end; what takes no time is moved as a whole."""
        if not self.is_arc:
            at_s = next(t_s for t_s in (start_s, end_s, self.at_s) if t_s is not None)
            return replace(self, at_s=at_s, start_s=at_s, end_s=at_s)
        return replace(
            self,
            start_s=self.start_s if start_s is None else start_s,
            end_s=self.end_s if end_s is None else end_s,
        )

    def drained(self, burnt: float) -> Effect:
        """Return a burn as it is if the tank holds less for it: at the same thrust, but over sooner."""
        gain = scaled(self.vector, math.log1p(-burnt) / math.log1p(-self.burnt))
        end_s = self.start_s + (self.end_s - self.start_s) * burnt / self.burnt
        effect = replace(self, vector=gain, burnt=burnt, end_s=end_s)
        if not self.is_arc or effect.end_s - effect.start_s >= ARC_S_MIN:
            return effect
        return replace(effect, kind="impulse", at_s=self.start_s, end_s=self.start_s)


class Timeline:
    """The effects of one vehicle that truth may still depend on, in order."""

    def __init__(self, ballistic_m2_kg: float = 0.0, *, is_felt: bool = False) -> None:
        self.ballistic_m2_kg = ballistic_m2_kg
        """Ballistic coefficient before the first effect held."""
        self.is_felt = is_felt
        """Whether an accelerometer on board feels the drag that acts on it."""
        self.wheels_n_m_s: Vector = (0.0, 0.0, 0.0)
        """Momentum that wheels had taken up before the first effect held, body axes, N m s."""
        self.effects: tuple[Effect, ...] = ()
        self.thrusts: dict[int, Thrust] = {}
        """Of the thrust arcs that truth already holds, by the effect's number."""

    def add(self, effect: Effect) -> None:
        """Put an effect where its time belongs; those of one time stay as they were taken."""
        effects = (*self.effects, effect)
        self.effects = tuple(sorted(effects, key=lambda e: (e.start_s, e.number)))

    def exchange(self, effect: Effect, other: Effect | None) -> None:
        """Put another effect in the place of one, or none; what truth holds of the arc stays."""
        self.effects = tuple(
            each
            for one in self.effects
            if (each := other if one.number == effect.number else one) is not None
        )

    def from_time(self, t_s: float) -> tuple[Effect, ...]:
        """Return those that act at *t_s* or begin after it; what acts once at *t_s* is in its state already."""
        return tuple(e for e in self.effects if e.start_s > t_s or e.end_s > t_s)

    def between(self, t0_s: float, t1_s: float) -> tuple[Effect, ...]:
        """Return those that act within (t0_s, t1_s], or later before the middle of a thrust arc that begins by then."""
        later = self.from_time(t0_s)
        middles_s = (e.at_s for e in later if e.kind == "thrust" and e.start_s <= t1_s)
        until_s = max(middles_s, default=t1_s)  # where the arc's axes are taken
        return tuple(e for e in later if e.start_s <= max(t1_s, until_s))

    def changed_from(self, effect: Effect, ready_s: float) -> float:
        """
        Return from when an effect makes truth another one.

        That is its beginning, or that of a burn in body axes that begins before it and is yet to come: at its middle the
        axes are other ones now.

        Args:
            effect: One of them.
            ready_s: From when on truth can be changed.
        """
        burns_s = (
            each.start_s
            for each in self.effects
            if each.kind == "thrust"
            and each.frame == "body"
            and ready_s <= each.start_s < effect.start_s < each.at_s
        )
        return min(burns_s, default=effect.start_s) if effect.kind in TURNING else effect.start_s

    def ballistic_at(self, t_s: float) -> float:
        """Return the ballistic coefficient from *t_s* on, m^2/kg."""
        value = self.ballistic_m2_kg
        for effect in self.effects:
            if effect.kind == "ballistic" and effect.start_s <= t_s:
                value = effect.vector[0]
        return value

    def wheels_at(self, t_s: float) -> Vector:
        """Return the momentum that wheels have taken up until *t_s*, body axes, N m s."""
        taken = [self.wheels_n_m_s]
        for effect in self.effects:
            if effect.kind == "torque" and effect.start_s < t_s:
                taken.append(scaled(effect.vector, effect.start_s - min(t_s, effect.end_s)))
        return total(taken)

    def wheels_from(self, t_s: float) -> tuple[Vector, Vector]:
        """Return the least and the largest momentum that wheels take up at *t_s* and later, body axes, N m s."""
        later = (e.end_s for e in self.effects if e.kind == "torque" and e.end_s > t_s)
        held = [self.wheels_at(at_s) for at_s in (t_s, *later)]
        x, y, z = zip(*held, strict=True)
        return (min(x), min(y), min(z)), (max(x), max(y), max(z))

    def forget_before(self, t_s: float) -> None:
        """Drop what is over before *t_s*."""
        if not self.effects or self.effects[0].start_s >= t_s:
            return
        over = tuple(e for e in self.effects if e.end_s < t_s)
        kept = tuple(e for e in self.effects if e.end_s >= t_s)
        self.effects = over
        self.ballistic_m2_kg, self.wheels_n_m_s = self.ballistic_at(t_s), self.wheels_at(t_s)
        self.effects = kept
        held = {e.number for e in self.effects}
        self.thrusts = {n: thrust for n, thrust in self.thrusts.items() if n in held}


def total(vectors: Iterable[Vector]) -> Vector:
    """Return the sum of vectors; zero for none."""
    x = y = z = 0.0
    for a, b, c in vectors:
        x, y, z = x + a, y + b, z + c
    return x, y, z


def scaled(vector: Vector, factor: float) -> Vector:
    """Return *factor* times a vector."""
    return vector[0] * factor, vector[1] * factor, vector[2] * factor


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """Truth of one vehicle over some time, with equally spaced knots of its own."""

    t0_s: float
    knot_s: float
    states: NDArray[np.float64]
    """Shape (K, 6), m and m/s, K >= 2."""
    end_s: float
    """Until when it holds: the last knot's time, or sooner if a maneuver has cut it short."""
    attitude: NDArray[np.float64] | None = None
    """Shape (K, 7) for a rigid body."""
    thrust: Thrust | None = None

    def cut_at(self, t_s: float) -> Piece:
        """Return it with truth up to *t_s* only."""
        return replace(self, end_s=min(self.end_s, t_s))

    def knot_before(self, t_s: float) -> int:
        """Return the number of its last knot before *t_s*, which lies within it."""
        return max(0, math.ceil((t_s - self.t0_s) / self.knot_s - 1e-9) - 1)

    def to_segments(self, revision: int, ballistic_m2_kg: float | None = None) -> Iterator[Segment]:
        """Yield the piece as it travels, nearly always one segment; a later one cuts off what does not hold any more."""
        for first, last in knot_runs(0, len(self.states) - 1):
            t0_s = self.t0_s + first * self.knot_s
            if first and t0_s >= self.end_s:
                return
            rows = slice(first, last + 1)
            yield Segment(
                revision=revision,
                t0_s=t0_s,
                knot_s=self.knot_s,
                states=self.states[rows],
                attitude=None if self.attitude is None else self.attitude[rows],
                thrust=self.thrust,
                ballistic_m2_kg=ballistic_m2_kg,
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleTruth:
    """One vehicle's truth from some time on, as `truth.vehicle_propagation.propagate_vehicle` returns it."""

    change_s: float
    """From when it holds."""
    pieces: tuple[Piece, ...]
    """In order of time; between them the grid holds."""
    first_knot: int
    """The first knot of the grid at or after change_s."""
    states: NDArray[np.float64]
    """At the knots of the grid from first_knot on, shape (G, 6); G may be 0."""
    attitude: NDArray[np.float64] | None
    """The same, shape (G, 7)."""
    invariants: NDArray[np.float64]
    """The same, shape (G, 3), see `orbit.invariants`."""
    thrusts: dict[int, Thrust]
    """Of the thrust arcs that began by its end, by the effect's number."""


@dataclass(frozen=True, slots=True)
class KnotSpan:
    """Knots of a piece to be: count >= 2 of them, evenly from start_s to end_s."""

    start_s: float
    end_s: float
    count: int

    @property
    def knot_s(self) -> float:
        """Time between knots."""
        return (self.end_s - self.start_s) / (self.count - 1)

    def times_s(self) -> list[float]:
        """Return the knots' times; the ends exactly."""
        return [*(self.start_s + i * self.knot_s for i in range(self.count - 1)), self.end_s]


def spin_rad_s_max(knot_s: float) -> float:
    """Return the rate at which a body turns half a turn a knot: attitude between knots has no meaning then."""
    return math.pi / knot_s


def snap(t_s: float, knot_s: float) -> float:
    """Return *t_s*, or the grid knot that it means; a time so large that it has no knot's number stays."""
    number = t_s / knot_s
    if not math.isfinite(number):
        return t_s
    knot = round(number) * knot_s
    return knot if abs(knot - t_s) <= SNAP_S else t_s


def knot_at_or_after(t_s: float, knot_s: float) -> int:
    """Return the number of the first grid knot that is not before a snapped time."""
    return math.ceil(t_s / knot_s - 1e-9)


def lay_out(
    start_s: float, end_s: float, knot_s: float, *, jumps: bool, is_arc: bool
) -> list[KnotSpan]:
    """
    Return the pieces that an interval needs besides the grid.

    Args:
        start_s: Its beginning, snapped.
        end_s: Its end, snapped, after start_s.
        knot_s: Time between knots of the grid.
        jumps: Whether the velocity changes at end_s, which the grid knot there will not show, or what
            drag acts on does.
        is_arc: Whether all of it is one piece, with dense knots.
    """
    if is_arc:
        return [_span(start_s, end_s, knot_s, ARC_INTERVALS_MIN)]
    first, last = knot_at_or_after(start_s, knot_s), math.floor(end_s / knot_s + 1e-9)
    head_end, tail = first, last
    if first * knot_s > start_s:
        head_end += first * knot_s - start_s < SHORT * knot_s
    if last * knot_s < end_s:
        tail -= end_s - last * knot_s < SHORT * knot_s
    elif jumps:
        tail -= 1
    has_head, has_tail = first * knot_s > start_s, tail * knot_s < end_s
    if (has_head or has_tail) and (head_end > tail or tail < first):
        return [_span(start_s, end_s, knot_s, 1)]
    spans = [_span(start_s, head_end * knot_s, knot_s, 1)] if has_head else []
    return spans + ([_span(tail * knot_s, end_s, knot_s, 1)] if has_tail else [])


def _span(start_s: float, end_s: float, knot_s: float, intervals_min: int) -> KnotSpan:
    intervals = max(intervals_min, math.ceil((end_s - start_s) / knot_s - 1e-9))
    return KnotSpan(start_s, end_s, intervals + 1)
