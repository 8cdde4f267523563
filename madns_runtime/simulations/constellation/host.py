"""
The host's half of the constellation: has truth computed ahead of time, hands it out, and lets commands change it.

This file puts the parts together and passes on what happens; the parts lie in `host_side`, what they
compute in `truth`. Agent number i of the run flies satellite number i.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext, HostSimulation, TimelineAction
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.host_side.injected_failures import InjectedFailures
from madns_runtime.simulations.constellation.host_side.maneuver_execution import Maneuvering
from madns_runtime.simulations.constellation.host_side.model_health import (
    AttitudeSpacing,
    Conservation,
)
from madns_runtime.simulations.constellation.host_side.radio import RadioMedium
from madns_runtime.simulations.constellation.host_side.slot_errors import SlotErrors
from madns_runtime.simulations.constellation.host_side.truth_distribution import Refills
from madns_runtime.simulations.constellation.host_side.truth_propagation import TruthSupply
from madns_runtime.simulations.constellation.messages import (
    Command,
    Initial,
)
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.truth.initial_states import InitialStates, load_fleet
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Timeline
from madns_runtime.simulations.constellation.truth.maneuvers.rules import (
    ManeuverDesk,
    Rules,
)
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    conserved_by,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import initial_attitude
from madns_runtime.simulations.constellation.truth.segments import TruthStore
from madns_runtime.simulations.constellation.vehicles import flight_rules, vehicle_of

WINDOWS_FIRST = 3
"""Windows computed before the start: two for the first buffer and the one after it."""
SEED_MAX = 2**63


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
        knot_s, has_drag = parameters.segments.knot_s, "drag" in self._propagation.forces
        self._store = store = TruthStore(
            len(context.agents),
            knots_per_window=max(1, round(parameters.segments.buffer_s / 2.0 / knot_s)),
            knot_s=knot_s,
            rigid=[n for n, vehicle in enumerate(vehicles) if vehicle.attitude is not None],
            timelines=[
                Timeline(
                    v.ballistic_m2_kg, is_felt=has_drag and v.sensors.accelerometer is not None
                )
                for v in vehicles
            ],
        )
        self._supply = TruthSupply(context, store, self._propagation, vehicles)
        # An exact propagation keeps what the epoch's states have.
        reference = conserved_by(fleet.states, self._propagation)
        self._conservation = Conservation(context, store, reference)
        limit_rad = parameters.record.attitude_error_rad_max
        self._spacing = None
        if self._supply.has_rigid_bodies:
            self._spacing = AttitudeSpacing(context, limit_rad=limit_rad, knot_s=knot_s)
        self._refills = Refills(
            context,
            self._supply,
            conservation=self._conservation,
            spacing=self._spacing,
            is_recorded=parameters.record.truth,
        )
        self._vehicles = vehicles
        has_devices = any(vehicle.actuation for vehicle in vehicles)
        self._maneuvering: Maneuvering | None = None
        if has_devices or flight_rules(parameters):
            self._maneuvering = self._make_maneuvering()
        self.radio = self._make_radio()
        self._gone: set[str] = set()
        """Agents that are lost, whatever their satellites."""
        self._slots = None
        if parameters.record.slots_hz is not None:
            self._slots = SlotErrors(context, parameters, store, fleet.names)
        self._failures = InjectedFailures(
            self._maneuvering_now, context, vehicles=vehicles, radio=self.radio, gone=self._gone
        )
        # Truth that came after its first sending was due.
        self._late_count, self._late_s_max = 0, 0.0
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
        Take a command.

        Raises:
            PluginError: It is none, or the scenario has no flight software.
        """
        kind = message.get("kind") if isinstance(message, Mapping) else None
        if kind != Command.KIND or self._maneuvering is None:
            raise PluginError(f"constellation: {agent}: expected a command, got {message!r:.200}")
        self._maneuvering.receive(self._index[agent], Command.from_message(message))

    def timer(self, t_s: float) -> float | None:
        """Do what is due and return when to come back."""
        times_s = []
        if self._maneuvering is not None:
            # Before truth is forgotten that a maneuver, late by however much, begins from.
            times_s.append(self._maneuvering.timer(t_s))
        times_s.append(self._refills.timer(t_s))
        if self.radio is not None:
            times_s.append(self.radio.timer(t_s))
        if self._slots is not None:
            times_s.append(self._slots.timer(t_s))
        return min((time_s for time_s in times_s if time_s is not None), default=None)

    def result(self, job: int, value: Any) -> None:
        """Take a part of truth or a change of it; truth that comes after its first sending was due is counted."""
        window, now_s = self._store.end, self._context.now_s()
        self._supply.jobs.take(job, value)
        if self._store.end > window:
            self._enter_late(window, now_s, "came")
            self._refills.submit_if_due(now_s)

    def begin_action(self, action: TimelineAction) -> None:
        """
        Put a failure in force.

        Raises:
            ActionRefused: There is nothing that could fail so.
        """
        self._failures.begin(action)
        self._count_slots()

    def end_action(self, action: TimelineAction) -> None:
        """Lift a failure."""
        self._failures.end(action)
        self._count_slots()

    def agent_lost(self, agent: str, reason: str) -> None:
        """Send it no more; its truth goes on."""
        self._refills.lost(self._index[agent])
        self._gone.add(agent)
        self._count_slots()

    def agent_rejoined(self, agent: str) -> None:
        """Send again, and at once what became due while it set itself up."""
        self._refills.rejoined(self._index[agent])
        self._failures.rejoined(agent)
        self._gone.discard(agent)
        self._count_slots()

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
            worst = conservation.energy_drift_agent or None
            checks.append(_check("constellation.energy_drift", limit, got, worst))
        summary: dict[str, Any] = {
            "propagator": self._parameters.propagator.kind,
            "frame": self._parameters.frame,
            "gravity": self._parameters.gravity,
            "epoch_utc": self._epoch_text(),
            "satellites": dict(zip(self._index, self._fleet.names, strict=True)),
            "segments_sent": self._refills.segments_sent,
            "propagations": self._supply.propagations,
            "truth_late": self._late_count,
            "truth_late_s_max": self._late_s_max,
            "energy_drift_max": conservation.energy_drift,
            "energy_drift_agent": conservation.energy_drift_agent,
            "momentum_z_drift_max": conservation.momentum_z_drift,
        }
        if self._spacing is not None:
            values, judged = self._spacing.finish()
            summary |= values
            checks += judged
        if self._maneuvering is not None:
            summary["maneuvers"] = maneuvers = self._maneuvering.finish()
            broken = maneuvers["inequality_broken"]
            name = "constellation.maneuver_deadlines_broken"
            checks.append(_check(name, 0, broken, maneuvers["inequality_broken_agent"]))
        if self.radio is not None:
            summary |= self.radio.finish()
        return summary | {"checks": checks}

    def _enter_late(self, window: int, now_s: float, what: str) -> None:
        """Count and tell truth whose first sending was due before now."""
        late_s = self._refills.lateness_s(window, now_s)
        if window < WINDOWS_FIRST or late_s <= 0.0:
            return
        self._late_count += 1
        self._late_s_max = max(self._late_s_max, late_s)
        self._context.log(
            "warning",
            f"truth from {window * self._store.window_s:g} s on {what} {late_s:.3f} s too late; "
            "a longer segments.buffer_s helps, and more executor workers do with many vehicles",
        )

    def _count_slots(self) -> None:
        """Leave out of the slots whose agents or satellites are lost at present."""
        if self._slots is not None:
            lost = self._gone | self._failures.lost
            self._slots.leave_out(self._index[agent] for agent in lost)

    def _maneuvering_now(self) -> Maneuvering:
        """Return who changes truth, also where nobody commands but a timeline."""
        if self._maneuvering is None:
            self._maneuvering = self._make_maneuvering()
        return self._maneuvering

    def _make_maneuvering(self) -> Maneuvering:
        """Return who carries commands out."""
        parameters, context, vehicles = self._parameters, self._context, self._vehicles
        rules = Rules(
            settings=parameters.maneuvers,
            can_maneuver=parameters.propagator.can_maneuver,
            can_magnetise=parameters.propagator.PROPERTIES.follows_dipoles,
            duration_s=context.duration_s,
            tick_hz=context.tick_hz,
            knot_s=self._store.knot_s,
            seed=int(context.random.integers(SEED_MAX)),
        )
        desk = ManeuverDesk(rules, context.agents, vehicles, self._store.timelines)
        if rules.can_maneuver:
            self._supply.warm_up(self._fleet.states)
        return Maneuvering(context, self._supply, self._refills, desk=desk, vehicles=vehicles)

    def _make_radio(self) -> RadioMedium | None:
        """Return who carries messages; nobody without flight software and radio."""
        parameters = self._parameters
        if parameters.crosslinks is None and not parameters.stations:
            return None
        names, epoch_utc = self._fleet.names, self._fleet.epoch_utc
        return RadioMedium(self._context, parameters, names, epoch_utc, self._store)

    def _epoch_text(self) -> str:
        return self._fleet.epoch_utc.isoformat().replace("+00:00", "Z")


def radio_of(host: ConstellationHost, context: HostContext) -> RadioMedium | None:
    """Return the medium of a run's messages between vehicles; see `plugin.api.Simulation.medium`."""
    return host.radio


def _attitude_at_epoch(
    fleet: InitialStates, vehicles: list[Vehicle]
) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """Return quaternions and rates of the rigid bodies, shape (M, 7); None without any."""
    rows = [
        initial_attitude(vehicle.attitude, state[:3], state[3:])
        for vehicle, state in zip(vehicles, fleet.states.tolist(), strict=True)
        if vehicle.attitude is not None
    ]
    return np.array(rows) if rows else None


def _check(name: str, limit: float, got: float, worst: str | None) -> dict[str, Any]:
    return {"name": name, "limit": limit, "got": got, "passed": got <= limit, "worst": worst}
