"""
Truth ahead of time: has the next windows computed for all vehicles, and a commanded one's anew.

One batch is under way at a time, cut into a job for each worker. A vehicle that is commanded is
propagated anew by a job, too, or where there is no time to wait behind others, in the loop: about a
millisecond for a point mass. What a batch then still says of it is mended when the batch arrives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.host_side.job_table import JobTable, Owner
from madns_runtime.simulations.constellation.host_side.truth_remainders import (
    TruthRemainders,
)
from madns_runtime.simulations.constellation.host_side.truth_remainders import (
    split as split_change,
)
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Effect, VehicleTruth
from madns_runtime.simulations.constellation.truth.orbit_curves import OrbitCurve
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    TruthStretch,
    merge,
    propagate_part,
    split,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody
from madns_runtime.simulations.constellation.truth.segments import TruthStore
from madns_runtime.simulations.constellation.truth.vehicle_propagation import (
    VehicleRequest,
    propagate_bodies,
    propagate_vehicle,
    propagate_vehicles,
)
from madns_runtime.simulations.constellation.vehicles import field_of

Array = NDArray[np.float64]

ORBIT_KNOT_S_MAX = 5.0
"""Knots further apart do not tell the orbit between them well enough for the torques that depend on it."""
WARMING = Effect(
    number=0, kind="dipole", at_s=0.0, start_s=0.0, end_s=0.1, vector=(1e-9, 0.0, 0.0), frame="body"
)
"""Of no consequence: sets up what the first dipole needs."""
BODIES_PER_JOB = 50
"""Rigid bodies that share a call: fixed, since one step size for all shows in the last digits."""
VEHICLES_PER_JOB = 20
"""Commanded vehicles in a job: about 20 ms."""
MENDS_INLINE_MAX = 2
"""Vehicles mended in the loop; more are mended by another job."""
MENDING_ROUNDS_MAX = 4
"""After so many all that is left is mended in the loop: commands without end must not hold truth up."""


@dataclass(slots=True)
class _Batch:
    """The windows under way."""

    first_knot: int
    knots: int
    waiting: int = 0
    """Jobs under way."""
    parts: dict[int, TruthStretch] = field(default_factory=dict)
    attitude: dict[int, Array] = field(default_factory=dict)
    commanded: dict[int, VehicleTruth] = field(default_factory=dict)
    changed: set[int] = field(default_factory=set)
    """Vehicles commanded since their part was submitted."""
    rounds: int = 0

    def put_vehicles(self, vehicles: Sequence[int], truths: Sequence[VehicleTruth]) -> None:
        """Take the truth of commanded vehicles."""
        self.commanded |= dict(zip(vehicles, truths, strict=True))


class TruthSupply:
    """
    Truth of all vehicles, as far as it is known.

    Args:
        context: Whose executor works.
        store: Where truth is kept.
        propagation: Settings; what is one per vehicle is the supply's.
        vehicles: What they are like.
    """

    def __init__(
        self,
        context: HostContext,
        store: TruthStore,
        propagation: PropagationParameters,
        vehicles: Sequence[Vehicle],
    ) -> None:
        self.store = store
        self.jobs = JobTable(context)
        self.propagations = 0
        """Stretches asked for, each of all vehicles, however many workers share it."""
        self.propagated_anew = 0
        """Vehicles propagated anew because they were commanded."""
        self._context = context
        self._propagation = propagation
        self._vehicles = vehicles
        self._rigid = [n for n, vehicle in enumerate(vehicles) if vehicle.attitude is not None]
        self._magnetic = [n for n in self._rigid if _has_magnetorquers(vehicles[n])]
        self.has_rigid_bodies = bool(self._rigid)
        """Whether any vehicle has an attitude."""
        self.has_drag = "drag" in propagation.forces
        """Whether ballistic coefficients matter."""
        self._batch: _Batch | None = None
        self.remainders = TruthRemainders(
            context,
            store,
            self.jobs,
            request_of=self._remainder_request,
            parameters_of=self._parameters_of,
        )

    @property
    def is_busy(self) -> bool:
        """Whether windows are under way."""
        return self._batch is not None

    def warm_up(self, states: Array) -> None:
        """Propagate one vehicle here, so that no maneuver pays for what the first call sets up."""
        # A rigid body, if there is one, sets up both orbits and attitude.
        vehicle, state = (self._magnetic or self._rigid or [0])[0], states[0]
        if self._rigid:
            state = np.concatenate((states[vehicle], (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)))
        request = self._request(vehicle, 0.0, state, change_s=0.0, end_knot=1)
        propagate_vehicle(request, self._parameters_of(vehicle))
        if vehicle in self._magnetic:
            effects = (WARMING,)
            propagate_vehicle(replace(request, effects=effects), self._parameters_of(vehicle))

    def submit(self, windows: int, states: Array, attitude: Array | None) -> None:
        """
        Have the next windows computed.

        Args:
            windows: How many.
            states: At the last knot known, or the epoch's: shape (N, 6).
            attitude: Of the rigid bodies, shape (M, 7).
        """
        self.propagations += 1
        per_window = self.store.knots_per_window
        first_knot = self.store.end * per_window
        batch = self._batch = _Batch(first_knot=first_knot, knots=windows * per_window + 1)
        # Of these the states may be old ones: they are mended when the batch has come.
        batch.changed.update(self.remainders.vehicles)
        request = StretchRequest(
            first_knot=first_knot, knots=batch.knots, knot_s=self.store.knot_s, states=states
        )
        parameters = self._parameters_at(first_knot * self.store.knot_s)
        for place, part in enumerate(split(request, parameters, self._context.workers)):
            self._start(batch, partial(batch.parts.__setitem__, place), propagate_part, *part)
        if attitude is not None:
            self._submit_bodies(batch, np.concatenate((states[self._rigid], attitude), axis=1))
        end_s = self._batch_end_s(batch)
        commanded = [
            n
            for n, t in enumerate(self.store.timelines)
            if t.between(first_knot * self.store.knot_s, end_s)
        ]
        self._submit_vehicles(batch, commanded, states, attitude)

    def change(self, vehicle: int, change_s: float, *, in_parts: bool = False) -> bool:
        """
        Propagate a vehicle anew from where its timeline has changed; False if nothing is known of that time yet.

        Args:
            vehicle: Whose truth.
            change_s: From when its timeline has changed.
            in_parts: Whether what takes long may follow (`remainders`); for the last digits it makes a difference.

        Raises:
            PluginError: The time is over.
            ConfigurationError: It cannot be propagated.
        """
        request = self._change_request(vehicle, change_s)
        if request is None:
            return False
        urgent = split_change(request) if in_parts else None
        truth = propagate_vehicle(urgent or request, self._parameters_of(vehicle))
        self._replace(vehicle, truth)
        if urgent is not None:
            self.remainders.owe(urgent, vehicle, truth)
        return True

    def change_by_job(
        self, vehicle: int, change_s: float, then: Callable[[bool], None]
    ) -> int | None:
        """
        Have the same done by the executor.

        Args:
            vehicle: Whose truth.
            change_s: From when its timeline has changed.
            then: Told when the job is done whether truth holds the change; if truth has moved on meanwhile it
                must be made again.

        Returns:
            The job; None if nothing is known of that time.
        """
        request = self._change_request(vehicle, change_s)
        if request is None:
            return None
        store = self.store
        basis = (store.revisions[vehicle], store.end)

        def take(truths: list[VehicleTruth]) -> None:
            is_current = basis == (store.revisions[vehicle], store.end)
            if is_current:
                self._replace(vehicle, truths[0])
            then(is_current)

        return self.jobs.submit(take, propagate_vehicles, [request], [self._parameters_of(vehicle)])

    def turn_rad_s(self, vehicle: int, t_s: float) -> float:
        """Return the rate at which a rigid body turns just before *t_s*, or where truth ends; 0 of what is forgotten."""
        known = self.store.restart(vehicle, min(t_s, self.store.end_s))
        return 0.0 if known is None else float(np.linalg.norm(known[1][10:]))

    def _change_request(self, vehicle: int, change_s: float) -> VehicleRequest | None:
        store = self.store
        if change_s > store.end_s:
            # What is commanded for a time behind the batch, as all is where truth is late, must not hold it up.
            if self._batch is not None and change_s <= self._batch_end_s(self._batch):
                self._batch.changed.add(vehicle)
            return None
        is_magnetic = vehicle in self._magnetic and store.knot_s <= ORBIT_KNOT_S_MAX
        is_beyond = change_s > self.remainders.known_until_s(vehicle)
        if is_beyond or (is_magnetic and not self.remainders.leaves_orbit(vehicle)):
            self.remainders.settle(vehicle)
        restart = store.restart(vehicle, change_s)
        if restart is None:
            raise PluginError(f"constellation: truth of {change_s:g} s is over and forgotten")
        start_s, state = restart
        end_knot = store.end * store.knots_per_window
        request = self._request(vehicle, start_s, state, change_s=change_s, end_knot=end_knot)
        if not is_magnetic:
            return request
        known = store.orbit_from(vehicle, start_s)
        return request if known is None else replace(request, orbit=OrbitCurve(*known))

    def _replace(self, vehicle: int, truth: VehicleTruth) -> None:
        if self._batch is not None:
            self._batch.changed.add(vehicle)
        self.remainders.drop(vehicle)
        self.store.replace(vehicle, truth)
        self.propagated_anew += 1

    def _remainder_request(self, vehicle: int, from_s: float, state: Array) -> VehicleRequest:
        end_knot = self.store.end * self.store.knots_per_window
        return self._request(vehicle, from_s, state, change_s=from_s, end_knot=end_knot)

    def _finish(self, batch: _Batch) -> None:
        """Take over a batch whose jobs are all done."""
        self.remainders.settle_all()
        if batch.changed:
            states, attitude = self.store.last_states(), self.store.last_attitude()
            for vehicle in sorted(batch.changed):
                request = self._batch_request(batch, vehicle, states, attitude)
                batch.commanded[vehicle] = propagate_vehicle(request, self._parameters_of(vehicle))
        stretch = merge([batch.parts[place] for place in sorted(batch.parts)])
        turned = [batch.attitude[place] for place in sorted(batch.attitude)]
        self.store.add(stretch, np.concatenate(turned) if turned else None)
        for vehicle, truth in sorted(batch.commanded.items()):
            self.store.put(vehicle, truth)
        self._batch = None

    def _submit_bodies(self, batch: _Batch, states: Array) -> None:
        first_s = batch.first_knot * self.store.knot_s
        knots_s = np.arange(batch.first_knot, batch.first_knot + batch.knots) * self.store.knot_s
        parameters = self._parameters_at(first_s)
        for place in range(0, len(self._rigid), BODIES_PER_JOB):
            some = self._rigid[place : place + BODIES_PER_JOB]
            bodies = [body for n in some if (body := self._body(n, first_s)) is not None]
            rows = states[place : place + BODIES_PER_JOB]
            put = partial(batch.attitude.__setitem__, place)
            self._start(batch, put, propagate_bodies, bodies, rows, knots_s, parameters.of(some))

    def _submit_vehicles(
        self, batch: _Batch, vehicles: Sequence[int], states: Array, attitude: Array | None
    ) -> None:
        for place in range(0, len(vehicles), VEHICLES_PER_JOB):
            some = tuple(vehicles[place : place + VEHICLES_PER_JOB])
            requests = [self._batch_request(batch, vehicle, states, attitude) for vehicle in some]
            parameters = [self._parameters_of(vehicle) for vehicle in some]
            put = partial(batch.put_vehicles, some)
            self._start(batch, put, propagate_vehicles, requests, parameters)

    def _start(self, batch: _Batch, put: Owner, function: Any, *arguments: Any) -> None:
        batch.waiting += 1
        self.jobs.submit(partial(self._came, batch, put), function, *arguments)

    def _came(self, batch: _Batch, put: Owner, value: Any) -> None:
        """Take a value of a batch; the last one completes it, or has mended who was commanded meanwhile."""
        put(value)
        batch.waiting -= 1
        if batch.waiting:
            return
        if len(batch.changed) > MENDS_INLINE_MAX and batch.rounds < MENDING_ROUNDS_MAX:
            batch.rounds += 1
            self.remainders.settle_all()
            changed, batch.changed = sorted(batch.changed), set()
            states, attitude = self.store.last_states(), self.store.last_attitude()
            self._submit_vehicles(batch, changed, states, attitude)
        else:
            self._finish(batch)

    def _batch_end_s(self, batch: _Batch) -> float:
        return (batch.first_knot + batch.knots - 1) * self.store.knot_s

    def _batch_request(
        self, batch: _Batch, vehicle: int, states: Array, attitude: Array | None
    ) -> VehicleRequest:
        """Return what one vehicle's part of a batch asks for, from the last knot known."""
        start_s, end_knot = batch.first_knot * self.store.knot_s, batch.first_knot + batch.knots - 1
        state = states[vehicle]
        if attitude is not None and vehicle in self._rigid:
            state = np.concatenate((state, attitude[self._rigid.index(vehicle)]))
        return self._request(vehicle, start_s, state, change_s=start_s, end_knot=end_knot)

    def _request(
        self, vehicle: int, start_s: float, state: Array, *, change_s: float, end_knot: int
    ) -> VehicleRequest:
        timeline, knot_s = self.store.timelines[vehicle], self.store.knot_s
        return VehicleRequest(
            start_s=start_s,
            state=state,
            change_s=change_s,
            end_knot=end_knot,
            knot_s=knot_s,
            effects=timeline.between(start_s, end_knot * knot_s),
            thrusts=timeline.thrusts,
            ballistic_m2_kg=timeline.ballistic_at(start_s),
            body=self._body(vehicle, start_s),
        )

    def _body(self, vehicle: int, t_s: float) -> RigidBody | None:
        described = self._vehicles[vehicle].attitude
        if described is None:
            return None
        has_wheels = described.wheels is not None
        return RigidBody.of(
            described,
            self.store.timelines[vehicle].wheels_at(t_s) if has_wheels else None,
            field=field_of(self._vehicles[vehicle]),
        )

    def _parameters_at(self, t_s: float) -> PropagationParameters:
        """Return the settings for all vehicles at a time."""
        if not self.has_drag:
            return self._propagation
        ballistic = np.array([timeline.ballistic_at(t_s) for timeline in self.store.timelines])
        return replace(self._propagation, ballistic_m2_kg=ballistic)

    def _parameters_of(self, vehicle: int) -> PropagationParameters:
        """Return the settings for one vehicle by itself."""
        return replace(self._propagation.of([vehicle]), element_sets=())


def _has_magnetorquers(vehicle: Vehicle) -> bool:
    return vehicle.attitude is not None and vehicle.attitude.magnetorquers is not None
