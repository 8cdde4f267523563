"""
The host's store of truth: stretches cut into windows, windows into each vehicle's segments. Pure.

Simulated time is divided into windows of equal length, half an agent's buffer. Window w covers the
knots w n to (w + 1) n, both included, so that every segment can be interpolated by itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.truth.propagation import Stretch


class TruthStore:
    """Windows of truth, oldest dropped first; bounded by who drops them."""

    def __init__(self, vehicles: int, *, knots_per_window: int, knot_s: float) -> None:
        self.knots_per_window = knots_per_window
        self.knot_s = knot_s
        self.window_s = knots_per_window * knot_s
        self.revisions = [0] * vehicles
        """One a vehicle, raised by whoever replaces its future."""
        self.oldest = 0
        """The first window kept."""
        self.end = 0
        """The first window not yet known."""
        self._states: dict[int, NDArray[np.float64]] = {}
        self._invariants: dict[int, NDArray[np.float64]] = {}

    def add(self, stretch: Stretch) -> None:
        """
        Take the windows that follow the last known one.

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
            self._states[self.end] = stretch.states[:, first : first + n + 1]
            self._invariants[self.end] = stretch.invariants[:, first : first + n + 1]
            self.end += 1

    def last_states(self) -> NDArray[np.float64]:
        """Return the states at the last knot known, shape (N, 6): where the next stretch begins."""
        last: NDArray[np.float64] = self._states[self.end - 1][:, -1]
        return last.copy()

    def segment(self, vehicle: int, first: int, last: int) -> Segment | None:
        """Return a vehicle's segment over windows *first* to *last*, as far as they are kept."""
        first, last = max(first, self.oldest), min(last, self.end - 1)
        if first > last:
            return None
        parts = [self._states[first][vehicle]]
        parts += [self._states[window][vehicle, 1:] for window in range(first + 1, last + 1)]
        return Segment(
            revision=self.revisions[vehicle],
            t0_s=first * self.knots_per_window * self.knot_s,
            knot_s=self.knot_s,
            states=np.concatenate(parts),
        )

    def invariants(self, vehicle: int, window: int) -> NDArray[np.float64]:
        """Return what is conserved, at every knot of a window, shape (knots_per_window + 1, 3)."""
        values: NDArray[np.float64] = self._invariants[window][vehicle]
        return values

    def drop_before(self, window: int) -> None:
        """Forget the windows before *window*; the last known one is always kept."""
        while self.oldest < min(window, self.end - 1):
            del self._states[self.oldest], self._invariants[self.oldest]
            self.oldest += 1


class RefillSchedule:
    """
    When each vehicle gets each window.

    A window is sent to all vehicles, evenly spread, in the quarter of a buffer before half of the
    buffer is left: nobody ever has less, and no instant sees a burst of all vehicles.
    """

    def __init__(self, vehicles: int, window_s: float) -> None:
        self.vehicles = vehicles
        self.window_s = window_s

    def send_s(self, window: int, vehicle: int) -> float:
        """Return the simulated time at which *window* is due to *vehicle*."""
        share = (vehicle + 1) / self.vehicles
        return (window - 1.5 + 0.5 * share) * self.window_s

    def wanted_s(self, window: int) -> float:
        """Return when *window* is to be computed: one and a half windows before its first sending."""
        return (window - 3) * self.window_s
