"""
The host's half of the constellation: has truth computed ahead of time and hands it out in segments.

Nothing is propagated in the loop. One job at a time computes the next windows for all vehicles; the
timer sends each vehicle its next segment when it is due, a few a call, so that no call takes long
and no instant sees a burst.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext, HostSimulation
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.messages import Initial
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.invariants import (
    ENERGY,
    MOMENTUM,
    MOMENTUM_Z,
    invariants,
)
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    ScipyPropagator,
)
from madns_runtime.simulations.constellation.truth.fleet import load_fleet
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    Stretch,
    StretchRequest,
    propagate_stretch,
)
from madns_runtime.simulations.constellation.truth.segments import RefillSchedule, TruthStore

WINDOWS_FIRST = 3
"""Windows computed before the start: two for the first buffer and the one after it."""
SENDS_PER_TIMER_MAX = 4
"""Segments sent in one call: about 0.1 ms."""
TIMER_STEP_S = 0.001
"""Until the next call when more segments are due than one call sends."""
RETRY_S = 0.02
"""Until the next look for truth that is due but not computed yet."""

INVARIANTS = (
    Field("t_s", "s"),
    Field("agent", "", "str"),
    Field("energy_j_kg", "J/kg"),
    Field("momentum_m2_s", "m^2/s"),
    Field("momentum_z_m2_s", "m^2/s"),
    Field("energy_drift", "1"),
    Field("momentum_z_drift", "1"),
)
"""Health of the model: one record a vehicle and window; drifts are relative to simulated time zero."""


@dataclass(slots=True)
class _Counts:
    """What the summary tells."""

    segments_sent: int = 0
    jobs: int = 0
    truth_late: int = 0
    truth_late_s_max: float = 0.0
    energy_drift: float = 0.0
    energy_drift_agent: str = ""
    momentum_z_drift: float = 0.0


class ConstellationHost(HostSimulation):
    """Holds the truth of all vehicles; agent number i of the run flies satellite number i."""

    def setup(self, context: HostContext) -> None:
        """
        Load the satellites and have the first windows computed.

        Raises:
            ConfigurationError: The satellites cannot be loaded.
            MissingExtraError: sgp4 is needed and not installed.
        """
        parameters = context.parameters
        assert isinstance(parameters, ConstellationParameters)
        self._context = context
        self._parameters = parameters
        self._fleet = load_fleet(parameters, len(context.agents), context.base_directory)
        self._index = {agent: number for number, agent in enumerate(context.agents)}
        self._propagation = PropagationParameters(
            settings=parameters.propagator,
            gravity=GRAVITY_MODELS[parameters.gravity],
            epoch_utc=self._fleet.epoch_utc,
            element_sets=self._fleet.element_sets,
        )
        count, knot_s = len(context.agents), parameters.segments.knot_s
        knots = max(1, round(parameters.segments.buffer_s / 2.0 / knot_s))
        self._store = TruthStore(count, knots_per_window=knots, knot_s=knot_s)
        self._schedule = RefillSchedule(count, self._store.window_s)
        self._windows = max(1, math.ceil(context.duration_s / self._store.window_s - 1e-9))
        # An exact propagation keeps what the epoch's states have.
        self._reference = invariants(
            self._fleet.states, self._propagation.gravity, with_j2=self._propagation.has_j2
        )
        self._active = [True] * count
        self._sent_until = [0] * count
        self._cursor = 0
        self._job: int | None = None
        self._counts = _Counts()
        context.open_stream("invariants", INVARIANTS)
        self._submit(min(WINDOWS_FIRST, self._windows), self._fleet.states)

    def initial_data(self, agent: str) -> Mapping[str, Any]:
        """Return the vehicle's truth from now on for a whole buffer, as far as it is computed."""
        vehicle = self._index[agent]
        now = self._window_at(self._context.now_s())
        # What its turn has passed already will not come again.
        last = max(now + 1, self._turns_passed(vehicle) - 1)
        segments = self._store.segments(vehicle, now, last)
        self._sent_until[vehicle] = min(last + 1, self._store.end)
        initial = Initial(
            satellite=self._fleet.names[vehicle],
            frame=self._parameters.frame,
            epoch_utc=self._fleet.epoch_utc.isoformat().replace("+00:00", "Z"),
            segment=segments[0] if segments else None,
            more=tuple(segments[1:]),
        )
        return initial.to_message()

    def timer(self, t_s: float) -> float | None:
        """Send what is due, have computed what will be, and return when to come back."""
        self._store.drop_before(self._window_at(t_s))
        self._submit_if_due(t_s)
        for _ in range(SENDS_PER_TIMER_MAX):
            window, vehicle = divmod(self._cursor, len(self._active))
            if window >= self._windows:
                return None
            due_s = self._schedule.send_s(window, vehicle)
            if due_s > t_s:
                return self._next_s(due_s)
            if window >= self._store.end:
                return t_s + RETRY_S
            self._cursor += 1
            self._refill(vehicle, window)
            self._record_invariants(vehicle, window)
        return t_s + TIMER_STEP_S

    def result(self, job: int, value: Any) -> None:
        """Take a stretch of truth; one that comes after its first sending was due is counted."""
        if job != self._job or not isinstance(value, Stretch):
            raise PluginError(f"constellation: expected job {self._job}'s stretch, got job {job}'s")
        self._job = None
        window, now_s = self._store.end, self._context.now_s()
        self._store.add(value)
        late_s = now_s - self._schedule.send_s(window, 0)
        if window >= WINDOWS_FIRST and late_s > 0.0:
            self._counts.truth_late += 1
            self._counts.truth_late_s_max = max(self._counts.truth_late_s_max, late_s)
            self._context.log(
                "warning",
                f"truth from {window * self._store.window_s:g} s on came {late_s:.3f} s too late; "
                "more executor workers do not help one propagation, a longer buffer_s does",
            )
        self._submit_if_due(now_s)

    def agent_lost(self, agent: str, reason: str) -> None:
        """Send it no more; its truth goes on."""
        self._active[self._index[agent]] = False

    def agent_rejoined(self, agent: str) -> None:
        """Send again, and at once what became due while it set itself up."""
        vehicle = self._index[agent]
        self._active[vehicle] = True
        self._refill(vehicle, self._turns_passed(vehicle) - 1)

    def finish(self) -> Mapping[str, Any]:
        """Return how well truth was computed and sent."""
        counts = self._counts
        limit = self._parameters.record.energy_drift_max
        checks = []
        # SGP4 averages and drags: its energy moves by design and is recorded, not judged.
        if isinstance(self._parameters.propagator, ScipyPropagator):
            passed = counts.energy_drift <= limit
            checks.append(_check("constellation.energy_drift", limit, counts.energy_drift, passed))
        return {
            "propagator": self._parameters.propagator.kind,
            "frame": self._parameters.frame,
            "gravity": self._parameters.gravity,
            "epoch_utc": self._fleet.epoch_utc.isoformat().replace("+00:00", "Z"),
            "satellites": dict(zip(self._index, self._fleet.names, strict=True)),
            "segments_sent": counts.segments_sent,
            "propagations": counts.jobs,
            "truth_late": counts.truth_late,
            "truth_late_s_max": counts.truth_late_s_max,
            "energy_drift_max": counts.energy_drift,
            "energy_drift_agent": counts.energy_drift_agent,
            "momentum_z_drift_max": counts.momentum_z_drift,
            "checks": checks,
        }

    def _window_at(self, t_s: float) -> int:
        return min(max(0, math.floor(t_s / self._store.window_s)), self._windows - 1)

    def _turns_passed(self, vehicle: int) -> int:
        """Return the number of windows whose turn to be sent to this vehicle is over."""
        window, at = divmod(self._cursor, len(self._active))
        return window + (vehicle < at)

    def _next_s(self, due_s: float) -> float:
        """Return when to come back: the next sending, or the next submission if that is sooner."""
        if self._job is None and self._store.end < self._windows:
            return min(due_s, self._schedule.wanted_s(self._store.end))
        return due_s

    def _submit_if_due(self, t_s: float) -> None:
        wanted = self._job is None and 0 < self._store.end < self._windows
        if wanted and t_s >= self._schedule.wanted_s(self._store.end):
            self._submit(1, self._store.last_states())

    def _submit(self, windows: int, states: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        """Have the next windows computed; never more than one job is under way."""
        per_window = self._store.knots_per_window
        request = StretchRequest(
            first_knot=self._store.end * per_window,
            knots=windows * per_window + 1,
            knot_s=self._store.knot_s,
            states=states,
        )
        self._job = self._context.submit(propagate_stretch, request, self._propagation)
        self._counts.jobs += 1

    def _refill(self, vehicle: int, window: int) -> None:
        """Send a vehicle what it lacks up to and including *window*."""
        first = self._sent_until[vehicle]
        if not self._active[vehicle] or first > window:
            return
        self._sent_until[vehicle] = max(first, min(window + 1, self._store.end))
        agent = self._context.agents[vehicle]
        for segment in self._store.segments(vehicle, first, window):
            self._context.send(agent, segment.to_message(), Service.RELIABLE)
            self._counts.segments_sent += 1

    def _record_invariants(self, vehicle: int, window: int) -> None:
        """Record what the window's last knot conserves; the worst knot counts for the summary."""
        if window < self._store.oldest:
            return
        values = self._store.invariants(vehicle, window)
        reference = self._reference[vehicle]
        deviation = values - reference
        energy_drift = deviation[:, ENERGY] / abs(reference[ENERGY])
        # Relative to the whole momentum: a polar orbit's z component is next to nothing.
        momentum_drift = deviation[:, MOMENTUM_Z] / reference[MOMENTUM]
        counts = self._counts
        worst = float(np.abs(energy_drift).max())
        if worst > counts.energy_drift:
            counts.energy_drift = worst
            counts.energy_drift_agent = self._context.agents[vehicle]
        counts.momentum_z_drift = max(counts.momentum_z_drift, float(np.abs(momentum_drift).max()))
        energy, momentum, momentum_z = values[-1].tolist()
        end_s = (window + 1) * self._store.window_s
        drifts = (float(energy_drift[-1]), float(momentum_drift[-1]))
        agent = self._context.agents[vehicle]
        self._context.record("invariants", (end_s, agent, energy, momentum, momentum_z, *drifts))


def _check(name: str, limit: float, got: float, passed: bool) -> dict[str, Any]:
    return {"name": name, "limit": limit, "got": got, "passed": passed}
