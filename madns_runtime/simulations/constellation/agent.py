"""
An agent's half of the constellation: one vehicle with its truth, its sensors and its flight software.

Needs numpy and nothing of the host's side. A tick costs about 3 us besides recording, 8 us with
elements; their streams round them, to 10 um and 10 nm/s, which keeps a tick's records near 97 B at 10 Hz: what is flown on
from a record, in LEO, is 2 mm off after a day. The host's own record has every bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.plugin.api import (
    ActionRefused,
    AgentContext,
    AgentSimulation,
    Tick,
    TimelineAction,
)
from madns_runtime.simulations.constellation.actions import SensorFault
from madns_runtime.simulations.constellation.command_numbers import is_of_device
from madns_runtime.simulations.constellation.messages import (
    GROUND,
    CommandResult,
    Delivery,
    GroundText,
    Initial,
    SatelliteLoss,
    Segment,
    TankGauge,
    TransmissionRefusal,
)
from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_POLAR_RADIUS_M,
    GRAVITY_MODELS,
)
from madns_runtime.simulations.constellation.orbit.elements import element_numbers
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.record_rates import RecordedTicks
from madns_runtime.simulations.constellation.streams import ATTITUDE, ELEMENTS, STATE, TRUTH_CHANGES
from madns_runtime.simulations.constellation.vehicle.device_commands import DeviceCommands
from madns_runtime.simulations.constellation.vehicle.flight_tick import (
    Cockpit,
    fit_out,
    rate_of,
)
from madns_runtime.simulations.constellation.vehicle.recorded_results import RecordedResults
from madns_runtime.simulations.constellation.vehicle.stimuli import Stimuli
from madns_runtime.simulations.constellation.vehicle.truth_buffer import (
    TIME_EPSILON_S,
    TruthBuffer,
)
from madns_runtime.simulations.constellation.vehicles import flight_of, vehicle_of

EARTH_POLAR_RADIUS_M2 = EARTH_POLAR_RADIUS_M**2
TURN_DIGITS = tuple(field.digits for field in ELEMENTS[-3:])
"""Decimals on record of those elements that go round: raan, argp and mean anomaly."""
NEARLY_TURN_DEG = 359.9


class ConstellationAgent(AgentSimulation):
    """One vehicle."""

    def setup(self, context: AgentContext, initial: Mapping[str, Any]) -> None:
        """
        Take the first segment and declare the streams.

        Raises:
            PluginError: The initial data are not the host's.
        """
        parameters = context.parameters
        assert isinstance(parameters, ConstellationParameters)
        first = Initial.from_message(initial)
        if first.frame != parameters.frame:
            raise PluginError(
                f"constellation: expected truth in {parameters.frame}, got {first.frame}"
            )
        self._context = context
        self._satellite = first.satellite
        self._mu_m3_s2 = GRAVITY_MODELS[parameters.gravity].mu_m3_s2
        record, tick_hz = parameters.record, context.tick_hz
        self._elements_ticks = RecordedTicks(record.elements_hz, tick_hz)
        # A day at 1 Hz is 8 MB per agent: long runs may record less than every tick.
        self._state_ticks = RecordedTicks(record.state_hz or tick_hz, tick_hz)
        self._state_tick = 0
        self._elements_tick = 0
        self._served = 0
        self._left_s_min = math.inf
        self._revision = 0 if first.segment is None else first.segment.revision
        self._change_left_s_min = math.inf
        self._buffer = TruthBuffer()
        for segment in (first.segment, *first.more):
            if segment is not None:
                self._buffer.add(segment)
        self._reached_s = self._buffer.end_s
        """Farthest time of which truth was ever held, s: a refill goes beyond it, a change does not."""
        context.open_stream("state", STATE)
        context.open_stream("elements", ELEMENTS)
        vehicle = vehicle_of(parameters, context.name, first.satellite)
        if vehicle.attitude is not None:
            context.open_stream("attitude", ATTITUDE)
        self._sensors, self._cockpit = fit_out(context, first, vehicle=vehicle, buffer=self._buffer)
        self._rate = rate_of(flight_of(parameters, context.name, first.satellite), context.tick_hz)
        self._devices = None
        if vehicle.actuation:
            has_flight = self._cockpit is not None
            self._devices = DeviceCommands(context, vehicle, has_flight=has_flight)
        self._is_commanded = self._cockpit is not None or self._devices is not None
        self._phase_s = 0.0
        self._is_lost = False
        self._ticks_lost = self._messages_lost = self._radio_lost = 0
        self._flight_tick = 0
        self._has_early_steps = self._cockpit is not None and self._rate.steps_per_tick > 1
        self._has_begun = False
        self._recorded = None
        if self._is_commanded:
            context.open_stream("truth_changes", TRUTH_CHANGES)
            if parameters.recorded_agents is not None:
                self._recorded = RecordedResults(Path(parameters.recorded_agents, context.name))
        self._stimuli = Stimuli(vehicle.stimuli, context, first) if vehicle.stimuli else None

    def step(self, tick: Tick) -> None:
        """
        Record the truth of this tick; a tick without truth is counted and nothing is made up.

        Raises:
            BlamedError: The vehicle has met the Earth.
        """
        index, t_s = tick.index, tick.t_s
        # Its ticks lie that much behind their nominal times, and so do its maneuvers.
        phase_s = tick.deadline_s - t_s
        self._phase_s = phase_s = phase_s if phase_s > 0.0 else 0.0
        if self._recorded is not None:
            self._take_recorded(self._recorded, index)
        cockpit = self._cockpit
        if self._is_lost:
            cockpit = None
            self._ticks_lost += 1
        if cockpit is not None:
            cockpit.phase_s = phase_s
            if self._has_early_steps:
                self._step_early(index, t_s, cockpit)
        state = self._buffer.lookup(t_s)
        if state is not None:
            x, y, z = state[:3]
            if x * x + y * y + z * z < EARTH_POLAR_RADIUS_M2:
                raise BlamedError(f"{self._satellite} has met the Earth at {t_s:g} s")
            self._served += 1
            if index >= self._state_tick:
                self._record_state(index, state)
            if index >= self._elements_tick:
                self._record_elements(index, state)
        if self._sensors is not None and not self._is_lost:
            self._measure(index, t_s, state)
        if cockpit is not None and index >= self._flight_tick:
            # At the first tick at or after each of its times.
            every = self._rate.ticks_per_step
            self._flight_tick = index - index % every + every
            cockpit.step(index, t_s, state)
        if self._recorded is not None and cockpit is not None:
            self._recorded.commanded(index, cockpit.commands)
        if self._devices is not None and not self._is_lost:
            self._devices.step(index, t_s, phase_s)
        if self._stimuli is not None:
            self._stimuli.step(t_s)

    def _step_early(self, tick: int, tick_s: float, cockpit: Cockpit) -> None:
        """Do the steps of flight software since the tick before, but the one at the tick's own time."""
        has_begun, self._has_begun = self._has_begun, True
        # Who has just begun, or rejoined, was not there yet.
        for t_s in self._rate.early_times_s(tick) if has_begun else ():
            state = self._buffer.lookup(t_s)
            self._measure(tick, t_s, state)
            cockpit.step(tick, t_s, state, tick_s=tick_s)

    def _measure(self, tick: int, t_s: float, state: tuple[float, ...] | None) -> None:
        if self._sensors is not None:
            self._sensors.step(tick, t_s, state)
            if self._cockpit is not None:
                self._cockpit.take(self._sensors.news())

    def _record_state(self, tick: int, state: tuple[float, ...]) -> None:
        self._state_tick = self._state_ticks.after(tick)
        if len(state) == 6:
            self._context.record("state", (tick, *state))
        else:
            self._context.record("state", (tick, *state[:6]))
            self._context.record("attitude", (tick, *state[6:]))

    def receive(self, message: Any) -> None:
        """
        Take the next segment or what became of a command.

        Raises:
            PluginError: The host sent something else.
        """
        kind = message.get("kind") if isinstance(message, Mapping) else None
        if kind == Segment.KIND:
            self._take_segment(Segment.from_message(message))
        elif kind == CommandResult.KIND and self._is_commanded:
            result = CommandResult.from_message(message)
            if self._recorded is not None:
                self._recorded.hold_result(result)
            else:
                self._take_result(result)
        elif kind == TankGauge.KIND:
            self._read_gauge(TankGauge.from_message(message))
        elif kind == GroundText.KIND:
            self._take_text(GroundText.from_message(message))
        elif kind == SatelliteLoss.KIND:
            self._is_lost = SatelliteLoss.from_message(message).is_lost
        elif kind != CommandResult.KIND:
            raise PluginError(f"constellation: expected a segment, got {message!r:.200}")

    def begin_action(self, action: TimelineAction) -> None:
        """
        Have a sensor fail.

        Raises:
            ActionRefused: This vehicle does not model it.
        """
        fault: SensorFault = action.parameters  # type: ignore[assignment]  # an instance of its kind's class
        sensors = self._sensors
        refusal = (
            "this vehicle has no sensors"
            if sensors is None
            else sensors.begin_failure(action.number, fault)
        )
        if refusal:
            raise ActionRefused(refusal)

    def end_action(self, action: TimelineAction) -> None:
        """Have it work again."""
        if self._sensors is not None:
            self._sensors.end_failure(action.number)

    def hear(self, delivery: Delivery) -> None:
        """Take a message by radio; a broadcast also reaches those who fly nothing."""
        if self._is_lost:
            self._messages_lost += 1
            self._radio_lost += delivery.sender != GROUND
        elif self._cockpit is not None:
            self._cockpit.deliver(delivery)

    def refused(self, refusal: TransmissionRefusal) -> None:
        """Take that a message to others was refused."""
        if self._recorded is not None:
            self._recorded.hold_refusal(refusal)
        elif self._cockpit is not None:
            self._cockpit.refuse(refusal)

    def _take_recorded(self, recorded: RecordedResults, tick: int) -> None:
        """Take what has come by this tick and had come by it in the recorded run."""
        for result in recorded.take_results(tick):
            self._take_result(result)
        for refusal in recorded.refusals.take(tick):
            if self._cockpit is not None:
                self._cockpit.refuse(refusal)

    def _take_result(self, result: CommandResult) -> None:
        if self._devices is not None and is_of_device(result.number):
            self._devices.tell(result)
            if self._cockpit is not None:
                self._cockpit.read_gauges(result)
        elif self._cockpit is not None:
            self._cockpit.tell(result)

    def _take_text(self, text: GroundText) -> None:
        self.hear(Delivery(GROUND, text.t_s, text.t_s, text.text))

    def _read_gauge(self, gauge: TankGauge) -> None:
        if self._cockpit is not None and not self._is_lost:
            self._cockpit.read_tank(gauge.propellant_kg)

    def _take_segment(self, segment: Segment) -> None:
        now_s = self._context.now_s()
        left_s = self._buffer.end_s - now_s
        if self._buffer.add(segment) and segment.end_s > self._reached_s + TIME_EPSILON_S:
            self._reached_s = segment.end_s
            self._left_s_min = min(self._left_s_min, left_s)
        if self._stimuli is not None:
            self._stimuli.take(segment, now_s)
        if segment.revision > self._revision and self._is_commanded:
            self._revision = segment.revision
            left_s = segment.t0_s + self._phase_s - now_s
            self._change_left_s_min = min(self._change_left_s_min, left_s)
            self._context.record("truth_changes", (segment.revision, segment.t0_s, now_s, left_s))

    def abandon(self) -> None:
        """End the program that flies this vehicle, if it is one."""
        cockpit: Cockpit | None = getattr(self, "_cockpit", None)  # lost before it was set up
        if cockpit is not None:
            cockpit.abandon()

    def finish(self) -> Mapping[str, Any]:
        """Return how well this vehicle was served; any underrun breaks the run's verdict."""
        buffer = self._buffer
        flown = {} if self._cockpit is None else self._cockpit.finish()
        # What flight software wants judged is judged with the vehicle's own.
        checks = flown["flight"].pop("checks", []) if flown else []
        underruns = {
            "name": "constellation.underruns",
            "limit": 0,
            "got": buffer.underruns,
            "passed": buffer.underruns == 0,
        }
        return {
            "satellite": self._satellite,
            "ticks_served": self._served,
            "underruns": buffer.underruns,
            "segments": buffer.segments,
            "segments_refused": buffer.refused,
            "segments_superseded": buffer.superseded,
            "left_at_refill_s_min": self._left_s_min if math.isfinite(self._left_s_min) else None,
            "left_at_change_s_min": self._change_left_s_min
            if math.isfinite(self._change_left_s_min)
            else None,
            "joint_gap_m_max": buffer.joint_gap_m_max,
            **({} if self._sensors is None else {"sensors": self._sensors.summary()}),
            **({} if self._devices is None else {"actuation": self._devices.finish()}),
            **self._stimuli_summary(),
            **self._loss_summary(),
            **({"told_early": self._recorded.overflown} if self._recorded else {}),
            **flown,
            **self._message_counts(),
            "checks": [
                underruns,
                *self._silence_checks(),
                *(checks if isinstance(checks, list) else [checks]),
            ],
        }

    def _silence_checks(self) -> list[dict[str, Any]]:
        """Return the check of sensors that are devices: one that gave nothing, as others of its device did, left flight software blind."""
        silent = None if self._sensors is None else self._sensors.silent()
        if silent is None:
            return []
        named = {"worst": f"{self._context.name}: {', '.join(silent)}"} if silent else {}
        got = len(silent)
        name = "constellation.sensors_silent"
        return [{"name": name, "limit": 0, "got": got, "passed": not got, **named}]

    def _stimuli_summary(self) -> dict[str, Any]:
        stimuli = self._stimuli
        return {} if stimuli is None else {"stimuli": stimuli.finish(self._context.now_s())}

    def _loss_summary(self) -> dict[str, Any]:
        """Return what the satellite did not do and hear while it was lost; empty if it never was."""
        if not self._ticks_lost:
            return {}
        return {"while_lost": {"ticks": self._ticks_lost, "messages": self._messages_lost}}

    def _message_counts(self) -> dict[str, int]:
        """Return the counts of messages by radio, as flight software heard them; without it nobody did."""
        counts = self._context.message_counts()
        if self._cockpit is None:
            return {
                "messages_unheard": sum(counts[name] for name in ("received", "held", "no_room"))
            }
        # What came in a tick is told in flight software's next step: at its own rate that is later, or never.
        waiting, dropped = self._cockpit.unheard()
        return {
            "messages_received": counts["received"] - waiting - dropped - self._radio_lost,
            "messages_held": counts["held"] + waiting,
            "messages_late": counts["late"],
            "messages_refused": counts["no_room"] + dropped,
            "messages_unheard": 0,
        }

    def _record_elements(self, tick: int, state: tuple[float, ...]) -> None:
        self._elements_tick = self._elements_ticks.after(tick)
        try:
            a_m, e, *angles_rad = element_numbers(state[:6], self._mu_m3_s2)
        except ValueError:
            return  # an escape orbit has none of these
        i_deg, *turns_deg = map(math.degrees, angles_rad)
        around = map(_within_turn, turns_deg, TURN_DIGITS)
        self._context.record("elements", (tick, a_m, e, i_deg, *around))


def _within_turn(angle_deg: float, digits: int | None) -> float:
    """Return an angle below 360 deg, or 0 if *digits* decimals on record would make it a whole turn."""
    return 0.0 if angle_deg > NEARLY_TURN_DEG and round(angle_deg, digits) >= 360.0 else angle_deg
