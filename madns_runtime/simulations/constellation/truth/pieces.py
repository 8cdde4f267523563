"""
Pieces of truth that do not fit the grid of knots, and how a stretch of time is laid out in them. Pure.

Truth of a vehicle is kept at the knots of a grid common to all. Where something begins or ends between two
knots, or changes the velocity at one, pieces with knots of their own cover the intervals in question, so
that interpolation never spans a jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.thrust import Thrust

SNAP_S = 1e-7
"""A time this near to a knot is the knot's: 0.2 mm at 2 km/s."""
SHORT = 0.1
"""Part of a knot's time: a shorter piece is drawn out over the next interval, whose position would else lose
digits when its small steps are divided by a small time."""
ARC_INTERVALS_MIN = 4
"""Knots in an arc of thrust or torque are at least this dense."""


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

    def to_segment(self, revision: int) -> Segment:
        """Return the piece as it travels; a later segment cuts off what does not hold any more."""
        return Segment(
            revision=revision,
            t0_s=self.t0_s,
            knot_s=self.knot_s,
            states=self.states,
            attitude=self.attitude,
            thrust=self.thrust,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleTruth:
    """One vehicle's truth from some time on, as `truth.jobs.propagate_vehicle` returns it."""

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
class Span:
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
    """Return *t_s*, or the grid knot that it means."""
    knot = round(t_s / knot_s) * knot_s
    return knot if abs(knot - t_s) <= SNAP_S else t_s


def knot_at_or_after(t_s: float, knot_s: float) -> int:
    """Return the number of the first grid knot that is not before a snapped time."""
    return math.ceil(t_s / knot_s - 1e-9)


def lay_out(
    start_s: float, end_s: float, knot_s: float, *, jumps: bool, is_arc: bool
) -> list[Span]:
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


def _span(start_s: float, end_s: float, knot_s: float, intervals_min: int) -> Span:
    intervals = max(intervals_min, math.ceil((end_s - start_s) / knot_s - 1e-9))
    return Span(start_s, end_s, intervals + 1)
