"""
The host's half of the constellation: has truth computed ahead of time, hands it out, and lets commands change it.

This file puts the parts together and passes on what happens; the parts lie in `hosting`, what they
compute in `truth`. Agent number i of the run flies satellite number i.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext, HostSimulation
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.hosting.conservation import Conservation
from madns_runtime.simulations.constellation.hosting.maneuvering import Maneuvering
from madns_runtime.simulations.constellation.hosting.refills import Refills
from madns_runtime.simulations.constellation.hosting.supply import TruthSupply
from madns_runtime.simulations.constellation.hosting.traffic import Traffic
from madns_runtime.simulations.constellation.messages import (
    Command,
    Initial,
    Transmission,
)
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.truth.fleet import Fleet, load_fleet
from madns_runtime.simulations.constellation.truth.maneuvers import ManeuverDesk, Rules
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    can_maneuver,
    conserved_by,
)
from madns_runtime.simulations.constellation.truth.segments import TruthStore
from madns_runtime.simulations.constellation.vehicles import vehicle_of

WINDOWS_FIRST = 3
"""Windows computed before the start: two for the first buffer and the one after it."""
SEED_MAX = 2**63


@dataclass(slots=True)
class _Lateness:
    """Truth that came after its first sending was due."""

    count: int = 0
    s_max: float = 0.0


class ConstellationHost(HostSimulation):
    """Holds the truth of all vehicles."""

    def setup(self, context: HostContext) -> None:
        """
        Load the satellites and have the first windows computed.

        Raises:
            ConfigurationError: The satellites cannot be loaded.
            MissingExtraError: A library of the propagator's is not installed.
        """
        parameters = context.parameters
        assert isinstance(parameters, ConstellationParameters)
        self._context = context
        self._parameters = parameters
        self._fleet = fleet = load_fleet(parameters, len(context.agents), context.base_directory)
        self._index = {agent: number for number, agent in enumerate(context.agents)}
        self._propagation = PropagationParameters(
            settings=parameters.propagator,
            gravity=GRAVITY_MODELS[parameters.gravity],
            epoch_utc=fleet.epoch_utc,
            element_sets=fleet.element_sets,
            base_directory=str(context.base_directory),
            names=context.agents,
        )
        pairs = zip(context.agents, fleet.names, strict=True)
        vehicles = [vehicle_of(parameters, agent, satellite) for agent, satellite in pairs]
        knot_s = parameters.segments.knot_s
        self._store = store = TruthStore(
            len(context.agents),
            knots_per_window=max(1, round(parameters.segments.buffer_s / 2.0 / knot_s)),
            knot_s=knot_s,
            rigid=[n for n, vehicle in enumerate(vehicles) if vehicle.attitude is not None],
        )
        self._supply = TruthSupply(context, store, self._propagation, vehicles)
        # An exact propagation keeps what the epoch's states have.
        reference = conserved_by(fleet.states, self._propagation)
        self._conservation = Conservation(context, self._supply, reference)
        self._refills = Refills(context, self._supply, self._conservation)
        self._maneuvering = self._make_maneuvering(vehicles)
        self._traffic = self._make_traffic()
        self._late = _Lateness()
        windows = min(WINDOWS_FIRST, self._refills.windows)
        self._supply.submit(windows, fleet.states, _attitude_at_epoch(fleet, vehicles))

    def initial_data(self, agent: str) -> Mapping[str, Any]:
        """Return the vehicle's truth from now on for a whole buffer, as far as it is computed."""
        vehicle = self._index[agent]
        segments = self._refills.initial(vehicle)
        initial = Initial(
            satellite=self._fleet.names[vehicle],
            frame=self._parameters.frame,
            epoch_utc=self._epoch_text(),
            segment=segments[0] if segments else None,
            more=tuple(segments[1:]),
        )
        return initial.to_message()

    def receive(self, agent: str, message: Any) -> None:
        """
        Take a command, or what a vehicle says by radio.

        Raises:
            PluginError: It is neither, or the scenario has no flight software.
        """
        kind = message.get("kind") if isinstance(message, Mapping) else None
        if kind == Command.KIND and self._maneuvering is not None:
            self._maneuvering.receive(self._index[agent], Command.from_message(message))
        elif kind == Transmission.KIND and self._traffic is not None:
            self._traffic.receive(self._index[agent], Transmission.from_message(message))
        else:
            raise PluginError(
                f"constellation: {agent}: expected a command or a transmission, got {message!r:.200}"
            )

    def timer(self, t_s: float) -> float | None:
        """Do what is due and return when to come back."""
        times_s = []
        if self._maneuvering is not None:
            # Before truth is forgotten that a maneuver, late by however much, begins from.
            times_s.append(self._maneuvering.timer(t_s))
        times_s.append(self._refills.timer(t_s))
        if self._traffic is not None:
            times_s.append(self._traffic.timer(t_s))
        return min((time_s for time_s in times_s if time_s is not None), default=None)

    def result(self, job: int, value: Any) -> None:
        """Take a part of truth or a change of it; truth that comes after its first sending was due is counted."""
        if self._maneuvering is not None and self._maneuvering.result(job, value):
            return
        window, now_s = self._store.end, self._context.now_s()
        if not self._supply.result(job, value):
            return
        self._enter_late(window, now_s, "came")
        self._refills.submit_if_due(now_s)

    def agent_lost(self, agent: str, reason: str) -> None:
        """Send it no more; its truth goes on."""
        self._refills.lost(self._index[agent])

    def agent_rejoined(self, agent: str) -> None:
        """Send again, and at once what became due while it set itself up."""
        self._refills.rejoined(self._index[agent])

    def finish(self) -> Mapping[str, Any]:
        """Return how well truth was computed and sent, and what was done to it."""
        conservation = self._conservation
        if self._supply.is_busy:
            self._enter_late(self._store.end, self._context.now_s(), "has not come, by now")
        limit = self._parameters.record.energy_drift_max
        checks = []
        # SGP4 averages and drags: its energy moves by design and is recorded, not judged.
        if self._propagation.conserves_energy and not self._supply.has_drag:
            got = conservation.energy_drift
            checks.append(_check("constellation.energy_drift", limit, got, got <= limit))
        summary: dict[str, Any] = {
            "propagator": self._parameters.propagator.kind,
            "frame": self._parameters.frame,
            "gravity": self._parameters.gravity,
            "epoch_utc": self._epoch_text(),
            "satellites": dict(zip(self._index, self._fleet.names, strict=True)),
            "segments_sent": self._refills.segments_sent,
            "propagations": self._supply.propagations,
            "truth_late": self._late.count,
            "truth_late_s_max": self._late.s_max,
            "energy_drift_max": conservation.energy_drift,
            "energy_drift_agent": conservation.energy_drift_agent,
            "momentum_z_drift_max": conservation.momentum_z_drift,
        }
        if self._maneuvering is not None:
            summary["maneuvers"] = maneuvers = self._maneuvering.finish()
            broken = maneuvers["inequality_broken"]
            name = "constellation.maneuver_deadlines_broken"
            checks.append(_check(name, 0, broken, broken == 0))
        if self._traffic is not None:
            summary |= self._traffic.finish()
        return summary | {"checks": checks}

    def _enter_late(self, window: int, now_s: float, what: str) -> None:
        """Count and tell truth whose first sending was due before now."""
        late_s = self._refills.lateness_s(window, now_s)
        if window < WINDOWS_FIRST or late_s <= 0.0:
            return
        self._late.count += 1
        self._late.s_max = max(self._late.s_max, late_s)
        self._context.log(
            "warning",
            f"truth from {window * self._store.window_s:g} s on {what} {late_s:.3f} s too late; "
            "a longer segments.buffer_s helps, and more executor workers do with many vehicles",
        )

    def _make_maneuvering(self, vehicles: list[Vehicle]) -> Maneuvering | None:
        """Return who carries commands out; nobody without flight software."""
        parameters, context = self._parameters, self._context
        if parameters.flight is None:
            return None
        rules = Rules(
            settings=parameters.maneuvers,
            can_maneuver=can_maneuver(parameters.propagator),
            duration_s=context.duration_s,
            tick_hz=context.tick_hz,
            knot_s=self._store.knot_s,
            seed=int(context.random.integers(SEED_MAX)),
        )
        desk = ManeuverDesk(rules, context.agents, vehicles, self._supply.timelines)
        if rules.can_maneuver:
            self._supply.warm_up(self._fleet.states)
        return Maneuvering(context, self._supply, self._refills, desk)

    def _make_traffic(self) -> Traffic | None:
        """Return who carries messages; nobody without flight software and radio."""
        parameters = self._parameters
        if parameters.crosslinks is None and not parameters.stations:
            return None
        names, epoch_utc = self._fleet.names, self._fleet.epoch_utc
        return Traffic(self._context, parameters, names, epoch_utc, self._store)

    def _epoch_text(self) -> str:
        return self._fleet.epoch_utc.isoformat().replace("+00:00", "Z")


def _attitude_at_epoch(
    fleet: Fleet, vehicles: list[Vehicle]
) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """Return quaternions and rates of the rigid bodies, shape (M, 7); None without any."""
    if all(vehicle.attitude is None for vehicle in vehicles):
        return None
    # Imported here: it needs scipy, which point masses may do without.
    from madns_runtime.simulations.constellation.truth.attitude import initial_attitude

    rows = [
        initial_attitude(vehicle.attitude, state[:3], state[3:])
        for vehicle, state in zip(vehicles, fleet.states.tolist(), strict=True)
        if vehicle.attitude is not None
    ]
    return np.array(rows)


def _check(name: str, limit: float, got: float, passed: bool) -> dict[str, Any]:
    return {"name": name, "limit": limit, "got": got, "passed": passed}
