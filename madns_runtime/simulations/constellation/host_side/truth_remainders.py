"""
Remainders of changes of truth whose first seconds were urgent: propagated by the executor while those are flown.

The thesis lets S_sync be smaller than a batch, so that T_p(S_sync) is, too (2.5.2). Where a vehicle's whole
future takes long to propagate, only its first seconds are propagated before its maneuver. Until the rest is there,
the store holds the old future behind them: whoever wants more of that vehicle than its first seconds
settles it first.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from madns_runtime.plugin.api import HostContext
from madns_runtime.simulations.constellation.host_side.job_table import JobTable
from madns_runtime.simulations.constellation.truth.maneuvers.effects import VehicleTruth
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.segments import TruthStore
from madns_runtime.simulations.constellation.truth.vehicle_propagation import (
    VehicleRequest,
    propagate_vehicle,
    propagate_vehicles,
)

URGENT_S = 3.0
"""Of a change, how much is propagated before its time: the rest has until its end to be computed and to arrive."""
OVERTAKEN_S = 1.0
"""Before the end of what is flown, when a rest that the executor has not computed is computed in the loop."""
PATIENCE_S = 0.25
"""How long a rest is left: of a vehicle that is commanded at every tick only the last one is wanted."""
QUICK_S = 60.0
"""A point mass that coasts is propagated so far in about one step of the integrator: a shorter part takes as long."""
WORTH_IT = 3
"""A change is split if all of it is so many times as long as its urgent part."""

RequestOf = Callable[[int, float, NDArray[np.float64]], VehicleRequest]
"""Returns what to propagate of a vehicle: from a knot's time and its state there to the last knot known."""
ParametersOf = Callable[[int], PropagationParameters]
Followed = Callable[[int, float], None]
"""Told the vehicle, and from when on its truth is now whole."""


def split(request: VehicleRequest) -> VehicleRequest | None:
    """Return the urgent part of a change; None if all of it takes hardly longer."""
    knot_s, first_s = request.knot_s, request.change_s
    cut_knot = math.ceil((first_s + URGENT_S) / knot_s - 1e-9)
    cut_s, whole_s = cut_knot * knot_s - first_s, request.end_knot * knot_s - first_s
    is_slow = request.body is not None or any(each.kind == "thrust" for each in request.effects)
    if whole_s < WORTH_IT * cut_s or not (is_slow or whole_s > QUICK_S):
        return None
    return replace(request, end_knot=cut_knot)


@dataclass(slots=True)
class _Remainder:
    """The part that a vehicle's new future lacks."""

    from_s: float
    state: NDArray[np.float64]
    """At from_s, 6 numbers or 13."""
    keeps_orbit: bool
    """Whether the change left the orbit as it was known."""
    job: int | None = None
    """None until the executor is asked."""


class TruthRemainders:
    """
    All vehicles' remainders, at most one each.

    Args:
        context: Whose clock counts.
        store: Where truth is kept.
        jobs: Of the executor.
        request_of: Says what to propagate.
        parameters_of: The settings for a vehicle by itself.
    """

    def __init__(
        self,
        context: HostContext,
        store: TruthStore,
        jobs: JobTable,
        *,
        request_of: RequestOf,
        parameters_of: ParametersOf,
    ) -> None:
        self.settled_in_loop = 0
        """Remainders that the loop had to compute."""
        self.followed: Followed = _nobody
        self._context = context
        self._store = store
        self._jobs = jobs
        self._request_of = request_of
        self._parameters_of = parameters_of
        self._left: dict[int, _Remainder] = {}
        self._due: list[tuple[float, int, int, _Remainder]] = []
        """When to look at which remainder again; the count keeps them apart."""
        self._count = 0

    @property
    def vehicles(self) -> Iterable[int]:
        """The vehicles whose truth is not whole."""
        return tuple(self._left)

    def known_until_s(self, vehicle: int) -> float:
        """Return until when a vehicle's truth is its newest; infinity if all of it is."""
        left = self._left.get(vehicle)
        return math.inf if left is None else left.from_s

    def leaves_orbit(self, vehicle: int) -> bool:
        """Tell whether the orbit in the store is the vehicle's newest, all along."""
        left = self._left.get(vehicle)
        return left is None or left.keeps_orbit

    def owe(self, request: VehicleRequest, vehicle: int, truth: VehicleTruth) -> None:
        """Enter that of a change only *truth*, as *request* asked for it, is in the store."""
        from_s = request.end_knot * request.knot_s
        state: NDArray[np.float64] = truth.states[-1]
        if truth.attitude is not None:
            state = np.concatenate((state, truth.attitude[-1]))
        self._left[vehicle] = _Remainder(
            from_s=from_s, state=state, keeps_orbit=request.orbit is not None
        )
        self._come_back(vehicle, self._context.now_s() + PATIENCE_S)

    def drop(self, vehicle: int) -> None:
        """Forget a remainder that another change has replaced."""
        left = self._left.pop(vehicle, None)
        if left is not None and left.job is not None:
            self._jobs.give_up(left.job)

    def settle(self, vehicle: int) -> None:
        """Make a vehicle's truth whole, here and now."""
        left = self._left.get(vehicle)
        if left is None:
            return
        if left.job is not None:
            self._jobs.give_up(left.job)
        self.settled_in_loop += 1
        rest = self._request_of(vehicle, left.from_s, left.state)
        self._put(vehicle, propagate_vehicle(rest, self._parameters_of(vehicle)))

    def settle_all(self) -> None:
        """Make all truth whole, here and now."""
        for vehicle in self.vehicles:
            self.settle(vehicle)

    def timer(self, t_s: float) -> float | None:
        """Have remainders computed whose time has come, and return when to come back."""
        while self._due and self._due[0][0] <= t_s:
            _, _, vehicle, left = heapq.heappop(self._due)
            if self._left.get(vehicle) is not left:
                continue  # dropped, or settled already
            if left.from_s - OVERTAKEN_S <= t_s:
                self.settle(vehicle)
            elif left.job is None:
                left.job = self._submit(vehicle, left)
                self._come_back(vehicle, left.from_s - OVERTAKEN_S)
        return self._due[0][0] if self._due else None

    def _come_back(self, vehicle: int, at_s: float) -> None:
        self._count += 1
        heapq.heappush(self._due, (at_s, self._count, vehicle, self._left[vehicle]))
        self._context.wake(at_s)

    def _submit(self, vehicle: int, left: _Remainder) -> int:
        basis = self._store.end

        def take(truths: list[VehicleTruth]) -> None:
            if self._left.get(vehicle) is left and basis == self._store.end:
                self._put(vehicle, truths[0])

        rest = self._request_of(vehicle, left.from_s, left.state)
        return self._jobs.submit(take, propagate_vehicles, [rest], [self._parameters_of(vehicle)])

    def _put(self, vehicle: int, truth: VehicleTruth) -> None:
        left = self._left.pop(vehicle)
        self._store.put(vehicle, truth)
        self.followed(vehicle, left.from_s)


def _nobody(_vehicle: int, _from_s: float) -> None:
    """Tell nobody."""
