"""
The host's store of truth: stretches cut into windows, windows into each vehicle's segments. Pure.

Simulated time is divided into windows of equal length, half an agent's buffer. Window w covers the
knots w n to (w + 1) n, both included, so that every segment can be interpolated by itself. Beside the
grid of knots, a vehicle that was commanded has pieces with knots of its own (`truth.maneuvers.effects`); what is
known of it is one revision, and each change makes a new one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.messages import Segment, knot_runs
from madns_runtime.simulations.constellation.orbit.interpolation import (
    coefficients,
    evaluate,
    interpolate,
)
from madns_runtime.simulations.constellation.truth.maneuvers.effects import (
    Piece,
    Timeline,
    VehicleTruth,
    knot_at_or_after,
)
from madns_runtime.simulations.constellation.truth.propagation import TruthStretch

Array = NDArray[np.float64]


class TruthStore:
    """
    Windows of truth, oldest dropped first; bounded by who drops them.

    Args:
        vehicles: How many.
        knots_per_window: Intervals of the grid in a window.
        knot_s: Time between knots.
        rigid: Indices of the rigid bodies, in the order of a stretch's attitude.
        timelines: What is done to each vehicle; empty where nothing is.
    """

    def __init__(
        self,
        vehicles: int,
        *,
        knots_per_window: int,
        knot_s: float,
        rigid: Sequence[int] = (),
        timelines: Sequence[Timeline] = (),
    ) -> None:
        self.knots_per_window = knots_per_window
        self.knot_s = knot_s
        self.window_s = knots_per_window * knot_s
        self.timelines = timelines or [Timeline() for _ in range(vehicles)]
        """Timeline of effects on each vehicle, past and to come."""
        self.revisions = [0] * vehicles
        """One per vehicle, raised whenever its future is replaced."""
        self.oldest = 0
        """The first window kept."""
        self.end = 0
        """The first window not yet known."""
        self._rigid = {vehicle: row for row, vehicle in enumerate(rigid)}
        self._states: dict[int, Array] = {}
        self._attitude: dict[int, Array] = {}
        self._invariants: dict[int, Array] = {}
        self._pieces: dict[int, list[Piece]] = {}

    @property
    def end_s(self) -> float:
        """Simulated time of the last knot known."""
        return self.end * self.knots_per_window * self.knot_s

    def add(self, stretch: TruthStretch, attitude: Array | None = None) -> None:
        """
        Take the windows that follow the last known one.

        Args:
            stretch: All vehicles' truth on the grid.
            attitude: Of the rigid bodies, shape (M, K, 7).

        Raises:
            ValueError: The stretch does not begin there, or does not end with a window.
        """
        n = self.knots_per_window
        intervals = stretch.states.shape[1] - 1
        if stretch.first_knot != self.end * n or intervals < n or intervals % n:
            raise ValueError(
                f"expected whole windows from knot {self.end * n}, got {intervals} intervals "
                f"from {stretch.first_knot}"
            )
        for first in range(0, intervals, n):
            # Copies: a window that outlives its stretch must not keep all of it in memory.
            self._states[self.end] = stretch.states[:, first : first + n + 1].copy()
            self._invariants[self.end] = stretch.invariants[:, first : first + n + 1].copy()
            if attitude is not None:
                self._attitude[self.end] = attitude[:, first : first + n + 1].copy()
            self.end += 1

    def replace(self, vehicle: int, truth: VehicleTruth) -> None:
        """Put other truth in the place of a vehicle's, from truth.change_s on, under a new revision."""
        self.revisions[vehicle] += 1
        self._keep_until(vehicle, truth.change_s)
        self.put(vehicle, truth)

    def put(self, vehicle: int, truth: VehicleTruth) -> None:
        """Take a vehicle's truth as it is, pieces and grid, for a time of which nothing was sent."""
        self.timelines[vehicle].thrusts |= truth.thrusts
        if truth.pieces:
            self._pieces.setdefault(vehicle, []).extend(truth.pieces)
        n = self.knots_per_window
        for place in range(len(truth.states)):
            window, at = divmod(truth.first_knot + place, n)
            # Windows share their joints.
            for which, row in ((window, at), (window - 1, n)) if at == 0 else ((window, at),):
                if which not in self._states:
                    continue
                self._states[which][vehicle, row] = truth.states[place]
                self._invariants[which][vehicle, row] = truth.invariants[place]
                if truth.attitude is not None:
                    self._attitude[which][self._rigid[vehicle], row] = truth.attitude[place]

    def last_states(self) -> Array:
        """Return the states at the last knot known, shape (N, 6): where the next stretch begins."""
        last: Array = self._states[self.end - 1][:, -1]
        return last.copy()

    def last_attitude(self) -> Array | None:
        """Return quaternions and rates of the rigid bodies at the last knot known, shape (M, 7)."""
        if not self._rigid:
            return None
        last: Array = self._attitude[self.end - 1][:, -1]
        return last.copy()

    def restart(self, vehicle: int, t_s: float) -> tuple[float, Array] | None:
        """
        Return the last knot before *t_s*, its time and state: where propagation can begin anew.

        The state has 6 numbers, 13 for a rigid body; all that was changed by that time is in it. None
        if nothing is kept of that time.
        """
        piece = self._piece_at(vehicle, t_s, before=True)
        if piece is not None:
            index = piece.knot_before(t_s)
            parts = [piece.states[index]]
            if piece.attitude is not None:
                parts.append(piece.attitude[index])
            return piece.t0_s + index * piece.knot_s, np.concatenate(parts)
        knot = knot_at_or_after(t_s, self.knot_s) - 1
        if not self._holds_knot(knot):
            return None
        return knot * self.knot_s, self._knot(vehicle, knot)

    def orbit_from(self, vehicle: int, t_s: float) -> tuple[Array, Array] | None:
        """
        Return times and states of the grid's knots from the last one not after *t_s* to the last known.

        None if nothing is kept of that time, or if an effect changes the orbit between its knots.
        """
        first, last = math.floor(t_s / self.knot_s + 1e-9), self.end * self.knots_per_window
        if not self._holds_knot(first) or first >= last:
            return None
        effects = self.timelines[vehicle].from_time(first * self.knot_s)
        if any(effect.kind not in ("torque", "dipole") for effect in effects):
            return None
        rows = _gather(self._states, vehicle, (first, last), self.knots_per_window)
        times_s: Array = np.arange(first, last + 1, dtype=np.float64) * self.knot_s
        return times_s, rows

    def state(self, vehicle: int, t_s: float) -> tuple[float, ...] | None:
        """Return position (m) and velocity (m/s) at *t_s*, six numbers; None where nothing is known."""
        piece = self._piece_at(vehicle, t_s)
        if piece is not None:
            index = min(max(int((t_s - piece.t0_s) / piece.knot_s), 0), len(piece.states) - 2)
            first, second = piece.states[index].tolist(), piece.states[index + 1].tolist()
            s = (t_s - piece.t0_s) / piece.knot_s - index
            return evaluate(coefficients(first, second, piece.knot_s), s, piece.knot_s)
        place = self._interval(t_s)
        if place is None:
            return None
        window, index = place
        first, second = self._states[window][vehicle, index : index + 2].tolist()
        s = t_s / self.knot_s - (window * self.knots_per_window + index)
        return evaluate(coefficients(first, second, self.knot_s), s, self.knot_s)

    def states(self, t_s: float) -> Array | None:
        """Return all vehicles' positions (m) and velocities (m/s) at *t_s*, shape (N, 6); None if not known."""
        place = self._interval(t_s)
        if place is None:
            return None
        window, index = place
        knots = self._states[window][:, index : index + 2]
        t0_s = (window * self.knots_per_window + index) * self.knot_s
        found = interpolate(knots, np.array([t_s]), t0_s=t0_s, knot_s=self.knot_s)[:, 0]
        for vehicle in self._pieces:
            if self._piece_at(vehicle, t_s) is not None:
                found[vehicle] = self.state(vehicle, t_s)
        return found

    def segments(self, vehicle: int, first: int, last: int) -> list[Segment]:
        """Return a vehicle's segments over windows *first* to *last*, as far as they are kept, in order."""
        first, last = max(first, self.oldest), min(last, self.end - 1)
        if first > last:
            return []
        n = self.knots_per_window
        return self._segments(vehicle, first * n * self.knot_s, (last + 1) * n)

    def segments_from(
        self, vehicle: int, change_s: float, window: int, until_s: float = math.inf
    ) -> list[Segment]:
        """
        Return a vehicle's segments from a change on, which is a knot or a piece's first.

        Args:
            vehicle: Whose.
            change_s: Their beginning.
            window: The first window that is not wanted.
            until_s: A knot's time; what lies behind it is not wanted either.
        """
        last_knot = min(window, self.end) * self.knots_per_window
        if math.isfinite(until_s):
            last_knot = min(last_knot, round(until_s / self.knot_s))
        return self._segments(vehicle, change_s, last_knot)

    def invariants(self, vehicle: int, window: int) -> Array:
        """Return what is conserved, at every knot of a window, shape (knots_per_window + 1, 3)."""
        values: Array = self._invariants[window][vehicle]
        return values

    def drop_before(self, window: int) -> None:
        """Forget the windows before *window*; the last known one is always kept."""
        if self.oldest >= min(window, self.end - 1):
            return
        while self.oldest < min(window, self.end - 1):
            del self._states[self.oldest], self._invariants[self.oldest]
            self._attitude.pop(self.oldest, None)
            self.oldest += 1
        oldest_s = self.oldest * self.window_s
        for timeline in self.timelines:
            timeline.forget_before(oldest_s)
        for vehicle in list(self._pieces):
            kept = [piece for piece in self._pieces[vehicle] if piece.end_s > oldest_s]
            if kept:
                self._pieces[vehicle] = kept
            else:
                del self._pieces[vehicle]

    def _segments(self, vehicle: int, from_s: float, last_knot: int) -> list[Segment]:
        """Return pieces, and runs of the grid between them, from a time up to a knot."""
        result: list[Segment] = []
        at_s, end_s, revision = from_s, last_knot * self.knot_s, self.revisions[vehicle]
        for piece in self._pieces.get(vehicle, ()):
            if piece.end_s <= from_s or piece.t0_s >= end_s:
                continue
            if piece.t0_s > at_s:
                result += self._runs(vehicle, at_s, piece.t0_s)
            result += piece.to_segments(revision, self._felt_ballistic(vehicle, piece.t0_s))
            at_s = piece.end_s
        if at_s < end_s:
            result += self._runs(vehicle, at_s, end_s)
        return result

    def _runs(self, vehicle: int, start_s: float, end_s: float) -> Iterator[Segment]:
        """Yield the grid between two of its knots, as far as a segment can hold it in one."""
        n, row = self.knots_per_window, self._rigid.get(vehicle)
        start, end = round(start_s / self.knot_s), round(end_s / self.knot_s)
        ballistic_m2_kg = self._felt_ballistic(vehicle, start * self.knot_s)
        for knots in knot_runs(start, end):
            yield Segment(
                revision=self.revisions[vehicle],
                t0_s=knots[0] * self.knot_s,
                knot_s=self.knot_s,
                states=_gather(self._states, vehicle, knots, n),
                attitude=None if row is None else _gather(self._attitude, row, knots, n),
                ballistic_m2_kg=ballistic_m2_kg,
            )

    def _felt_ballistic(self, vehicle: int, t_s: float) -> float | None:
        """Return what drag acts on from a time on, m^2/kg; None where nobody on board feels it."""
        timeline = self.timelines[vehicle]
        return timeline.ballistic_at(t_s) if timeline.is_felt else None

    def _keep_until(self, vehicle: int, change_s: float) -> None:
        """Let what was known before *change_s* end there, in a piece of its own: its knot may change."""
        pieces = [p for p in self._pieces.get(vehicle, ()) if p.t0_s < change_s]
        if pieces and pieces[-1].end_s >= change_s:
            pieces[-1] = pieces[-1].cut_at(change_s)
        else:
            knot = knot_at_or_after(change_s, self.knot_s) - 1
            if self._holds_knot(knot) and self._holds_knot(knot + 1):
                rows = np.stack([self._knot(vehicle, knot), self._knot(vehicle, knot + 1)])
                pieces.append(
                    Piece(
                        t0_s=knot * self.knot_s,
                        knot_s=self.knot_s,
                        states=rows[:, :6],
                        end_s=change_s,
                        attitude=rows[:, 6:] if vehicle in self._rigid else None,
                    )
                )
        self._pieces[vehicle] = pieces

    def _piece_at(self, vehicle: int, t_s: float, *, before: bool = False) -> Piece | None:
        """Return the piece that holds at *t_s*, or (*before*) until it: at a joint the later one holds."""
        for piece in reversed(self._pieces.get(vehicle, ())):
            if before and piece.t0_s < t_s <= piece.end_s:
                return piece
            if not before and piece.t0_s <= t_s < piece.end_s:
                return piece
        return None

    def _interval(self, t_s: float) -> tuple[int, int] | None:
        """Return the window and the interval in it that hold *t_s*."""
        if not self.oldest * self.window_s <= t_s <= self.end_s or self.end == 0:
            return None
        knot = min(math.floor(t_s / self.knot_s), self.end * self.knots_per_window - 1)
        window, index = divmod(knot, self.knots_per_window)
        return (window, index) if window in self._states else None

    def _holds_knot(self, knot: int) -> bool:
        n = self.knots_per_window
        return self.oldest * n <= knot <= self.end * n and self.end > 0

    def _knot(self, vehicle: int, knot: int) -> Array:
        """Return the state at a knot held, 6 numbers or 13."""
        window, at = divmod(knot, self.knots_per_window)
        if window not in self._states:  # the last knot of all is the end of a window
            window, at = window - 1, self.knots_per_window
        state: Array = self._states[window][vehicle, at]
        if vehicle in self._rigid:
            return np.concatenate((state, self._attitude[window][self._rigid[vehicle], at]))
        return state.copy()


def _gather(windows: dict[int, Array], row: int, knots: tuple[int, int], n: int) -> Array:
    """Return one vehicle's rows at the knots from the first to the last, both included."""
    first, last = knots
    parts: list[Array] = []
    for window in range(first // n, (last - 1) // n + 1):
        start, stop = max(first, window * n), min(last, (window + 1) * n)
        # What a window shares with the one before it is taken once.
        skip = 1 if parts else 0
        parts.append(windows[window][row, start - window * n + skip : stop - window * n + 1])
    return np.concatenate(parts)


class RefillSchedule:
    """
    Schedule of the windows of each vehicle.

    A window is sent to all vehicles, evenly spread, in the quarter of a buffer before half of the
    buffer is left: nobody ever has less, and no instant sees a burst of all vehicles.
    """

    def __init__(self, vehicles: int, window_s: float) -> None:
        self.vehicles = vehicles
        self.window_s = window_s

    def send_s(self, window: int, vehicle: int) -> float:
        """Return the simulated time at which *window* is due to *vehicle*."""
        return (window - 1.5 + 0.5 * ((vehicle + 1) / self.vehicles)) * self.window_s

    def wanted_s(self, window: int) -> float:
        """Return when *window* is to be computed: one and a half windows before its first sending."""
        return (window - 3) * self.window_s
