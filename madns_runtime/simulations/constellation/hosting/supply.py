"""
Truth ahead of time: has the next windows computed for all vehicles, and a commanded one's anew.

One batch is under way at a time, cut into a job for each worker. A vehicle that is commanded is
propagated anew by a job, too, or where there is no time to wait behind others, in the loop: about a
millisecond for a point mass. What a batch then still says of it is mended when the batch arrives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.truth.batches import merge, propagate_part, split
from madns_runtime.simulations.constellation.truth.effects import Timeline
from madns_runtime.simulations.constellation.truth.jobs import (
    VehicleRequest,
    propagate_bodies,
    propagate_vehicle,
    propagate_vehicles,
)
from madns_runtime.simulations.constellation.truth.pieces import VehicleTruth
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    Stretch,
    StretchRequest,
)
from madns_runtime.simulations.constellation.truth.segments import TruthStore

if TYPE_CHECKING:
    from madns_runtime.simulations.constellation.truth.attitude import RigidBody

Array = NDArray[np.float64]

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
    waiting: dict[int, tuple[str, int]] = field(default_factory=dict)
    """Job -> what it computes and its place."""
    parts: dict[int, Stretch] = field(default_factory=dict)
    attitude: dict[int, Array] = field(default_factory=dict)
    commanded: dict[int, VehicleTruth] = field(default_factory=dict)
    asked: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """Job -> the commanded vehicles in it."""
    changed: set[int] = field(default_factory=set)
    """Vehicles commanded since their part was submitted."""
    rounds: int = 0


class TruthSupply:
    """
    Truth of all vehicles, as far as it is known.

    Args:
        context: Whose executor works.
        store: Where truth is kept.
        propagation: Settings; what is one a vehicle is the supply's.
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
        self.timelines = [Timeline(vehicle.ballistic_m2_kg) for vehicle in vehicles]
        """What was and will be done to each vehicle."""
        self.propagations = 0
        """Stretches asked for, each of all vehicles, however many workers share it."""
        self.propagated_anew = 0
        """Vehicles propagated anew because they were commanded."""
        self._context = context
        self._propagation = propagation
        self._vehicles = vehicles
        self._rigid = [n for n, vehicle in enumerate(vehicles) if vehicle.attitude is not None]
        self.has_drag = "drag" in propagation.forces
        """Whether ballistic coefficients matter."""
        self._batch: _Batch | None = None
        self._bases: dict[int, tuple[int, int]] = {}
        """Of changes that the executor computes: revision and windows known when they were asked for."""

    @property
    def is_busy(self) -> bool:
        """Whether windows are under way."""
        return self._batch is not None

    def warm_up(self, states: Array) -> None:
        """Propagate one vehicle here, so that no maneuver pays for what the first call sets up."""
        # A rigid body, if there is one, sets up both orbits and attitude.
        vehicle, state = (self._rigid or [0])[0], states[0]
        if self._rigid:
            state = np.concatenate((states[vehicle], (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)))
        request = VehicleRequest(
            start_s=0.0,
            state=state,
            change_s=0.0,
            end_knot=1,
            knot_s=self.store.knot_s,
            body=self._body(vehicle, 0.0),
        )
        propagate_vehicle(request, self._parameters_of(vehicle))

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
        request = StretchRequest(
            first_knot=first_knot, knots=batch.knots, knot_s=self.store.knot_s, states=states
        )
        parameters = self._parameters_at(first_knot * self.store.knot_s)
        for place, part in enumerate(split(request, parameters, self._context.workers)):
            self._start(batch, ("part", place), propagate_part, *part)
        if attitude is not None:
            self._submit_bodies(batch, np.concatenate((states[self._rigid], attitude), axis=1))
        end_s = (first_knot + batch.knots - 1) * self.store.knot_s
        commanded = [
            n
            for n, t in enumerate(self.timelines)
            if t.between(first_knot * self.store.knot_s, end_s)
        ]
        self._submit_vehicles(batch, commanded, states, attitude)

    def result(self, job: int, value: Any) -> bool:
        """
        Take a job's value; True if the windows under way are all known now.

        Raises:
            PluginError: No such job is under way.
        """
        batch = self._batch
        if batch is None or job not in batch.waiting:
            raise PluginError(f"constellation: job {job} belongs to no windows under way")
        what, place = batch.waiting.pop(job)
        if what == "part":
            batch.parts[place] = value
        elif what == "bodies":
            batch.attitude[place] = value
        else:
            batch.commanded |= dict(zip(batch.asked.pop(job), value, strict=True))
        if batch.waiting:
            return False
        if len(batch.changed) > MENDS_INLINE_MAX and batch.rounds < MENDING_ROUNDS_MAX:
            batch.rounds += 1
            changed, batch.changed = sorted(batch.changed), set()
            self._submit_vehicles(
                batch, changed, self.store.last_states(), self.store.last_attitude()
            )
            return False
        self._finish(batch)
        return True

    def change(self, vehicle: int, change_s: float) -> bool:
        """
        Propagate a vehicle anew from where its timeline has changed; False if nothing is known of that time yet.

        Raises:
            PluginError: The time is over.
            ConfigurationError: It cannot be propagated.
        """
        request = self._change_request(vehicle, change_s)
        if request is None:
            return False
        self._replace(vehicle, propagate_vehicle(request, self._parameters_of(vehicle)))
        return True

    def change_by_job(self, vehicle: int, change_s: float) -> int | None:
        """Have the same done by the executor; the job, for `take_change`, or None if nothing is known of that time."""
        request = self._change_request(vehicle, change_s)
        if request is None:
            return None
        parameters = [self._parameters_of(vehicle)]
        job = self._context.submit(propagate_vehicles, [request], parameters)
        self._bases[job] = (self.store.revisions[vehicle], self.store.end)
        return job

    def take_change(self, job: int, vehicle: int, truth: VehicleTruth) -> bool:
        """Take what the executor made of a change; False if truth has moved on meanwhile and it must be made again."""
        if self._bases.pop(job) != (self.store.revisions[vehicle], self.store.end):
            return False
        self._replace(vehicle, truth)
        return True

    def forget_job(self, job: int) -> None:
        """Let go of a change that is wanted no more from the executor."""
        del self._bases[job]

    def _change_request(self, vehicle: int, change_s: float) -> VehicleRequest | None:
        store, timeline = self.store, self.timelines[vehicle]
        if change_s > store.end_s:
            if self._batch is not None:
                self._batch.changed.add(vehicle)
            return None
        restart = store.restart(vehicle, change_s)
        if restart is None:
            raise PluginError(f"constellation: truth of {change_s:g} s is over and forgotten")
        start_s, state = restart
        return VehicleRequest(
            start_s=start_s,
            state=state,
            change_s=change_s,
            end_knot=store.end * store.knots_per_window,
            knot_s=store.knot_s,
            effects=timeline.from_time(start_s),
            thrusts=timeline.thrusts,
            ballistic_m2_kg=timeline.ballistic_at(start_s),
            body=self._body(vehicle, start_s),
        )

    def _replace(self, vehicle: int, truth: VehicleTruth) -> None:
        if self._batch is not None:
            self._batch.changed.add(vehicle)
        self.timelines[vehicle].thrusts |= truth.thrusts
        self.store.replace(vehicle, truth)
        self.propagated_anew += 1

    def with_drag(self, vehicle: int, segments: list[Segment]) -> list[Segment]:
        """Return segments as a vehicle with an accelerometer needs them: they say what drag acts on."""
        if not self.has_drag or self._vehicles[vehicle].sensors.accelerometer is None:
            return segments
        timeline = self.timelines[vehicle]
        return [replace(one, ballistic_m2_kg=timeline.ballistic_at(one.t0_s)) for one in segments]

    def drop_before(self, window: int) -> None:
        """Forget truth, and what was done to vehicles, before a window."""
        oldest = self.store.oldest
        self.store.drop_before(window)
        if self.store.oldest > oldest:
            for timeline in self.timelines:
                timeline.forget_before(self.store.oldest * self.store.window_s)

    def _finish(self, batch: _Batch) -> None:
        """Take over a batch whose jobs are all done."""
        if batch.changed:
            states, attitude = self.store.last_states(), self.store.last_attitude()
            for vehicle in sorted(batch.changed):
                request = self._request(batch, vehicle, states, attitude)
                batch.commanded[vehicle] = propagate_vehicle(request, self._parameters_of(vehicle))
        stretch = merge([batch.parts[place] for place in sorted(batch.parts)])
        turned = [batch.attitude[place] for place in sorted(batch.attitude)]
        self.store.add(stretch, np.concatenate(turned) if turned else None)
        for vehicle, truth in sorted(batch.commanded.items()):
            self.timelines[vehicle].thrusts |= truth.thrusts
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
            own = _some_of(parameters, some)
            self._start(batch, ("bodies", place), propagate_bodies, bodies, rows, knots_s, own)

    def _submit_vehicles(
        self, batch: _Batch, vehicles: Sequence[int], states: Array, attitude: Array | None
    ) -> None:
        for place in range(0, len(vehicles), VEHICLES_PER_JOB):
            some = tuple(vehicles[place : place + VEHICLES_PER_JOB])
            requests = [self._request(batch, vehicle, states, attitude) for vehicle in some]
            parameters = [self._parameters_of(vehicle) for vehicle in some]
            job = self._start(batch, ("vehicles", place), propagate_vehicles, requests, parameters)
            batch.asked[job] = some

    def _start(self, batch: _Batch, what: tuple[str, int], function: Any, *arguments: Any) -> int:
        job = self._context.submit(function, *arguments)
        batch.waiting[job] = what
        return job

    def _request(
        self, batch: _Batch, vehicle: int, states: Array, attitude: Array | None
    ) -> VehicleRequest:
        """Return what one vehicle's part of a batch asks for, from the last knot known."""
        store, timeline = self.store, self.timelines[vehicle]
        start_s, end_knot = batch.first_knot * store.knot_s, batch.first_knot + batch.knots - 1
        state = states[vehicle]
        if attitude is not None and vehicle in self._rigid:
            state = np.concatenate((state, attitude[self._rigid.index(vehicle)]))
        return VehicleRequest(
            start_s=start_s,
            state=state,
            change_s=start_s,
            end_knot=end_knot,
            knot_s=store.knot_s,
            effects=timeline.between(start_s, end_knot * store.knot_s),
            thrusts=timeline.thrusts,
            ballistic_m2_kg=timeline.ballistic_at(start_s),
            body=self._body(vehicle, start_s),
        )

    def _body(self, vehicle: int, t_s: float) -> RigidBody | None:
        described = self._vehicles[vehicle].attitude
        if described is None:
            return None
        from madns_runtime.simulations.constellation.truth.attitude import RigidBody

        has_wheels = described.wheels is not None
        return RigidBody.of(
            described, self.timelines[vehicle].wheels_at(t_s) if has_wheels else None
        )

    def _parameters_at(self, t_s: float) -> PropagationParameters:
        """Return the settings for all vehicles at a time."""
        if not self.has_drag:
            return self._propagation
        ballistic = np.array([timeline.ballistic_at(t_s) for timeline in self.timelines])
        return replace(self._propagation, ballistic_m2_kg=ballistic)

    def _parameters_of(self, vehicle: int) -> PropagationParameters:
        """Return the settings for one vehicle by itself."""
        names = self._propagation.names[vehicle : vehicle + 1]
        return replace(self._propagation, names=names, element_sets=())


def _some_of(parameters: PropagationParameters, vehicles: Sequence[int]) -> PropagationParameters:
    ballistic, sets = parameters.ballistic_m2_kg, parameters.element_sets
    return replace(
        parameters,
        element_sets=tuple(sets[n] for n in vehicles) if sets else (),
        ballistic_m2_kg=None if ballistic is None else ballistic[list(vehicles)],
        names=tuple(parameters.names[n] for n in vehicles) if parameters.names else (),
    )
