"""
An agent's half of the constellation: one vehicle with its truth, its sensors and its flight software.

Needs numpy and nothing of the host's side. A tick costs about 3 us besides recording, 8 us with
elements; values are rounded to 1 um and 1 nm/s, which keeps a tick's records near 103 B at 10 Hz: what is flown on
from a record, in LEO, is 0.3 mm off after a day. The host's own record has every bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.plugin.api import AgentContext, AgentSimulation, Tick
from madns_runtime.simulations.constellation.messages import (
    CommandResult,
    Delivery,
    Initial,
    Segment,
    TransmissionRefusal,
)
from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_POLAR_RADIUS_M,
    GRAVITY_MODELS,
)
from madns_runtime.simulations.constellation.orbit.elements import elements_from_state
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.streams import ATTITUDE, ELEMENTS, STATE, TRUTH_CHANGES
from madns_runtime.simulations.constellation.vehicle.device_commands import (
    DEVICE_NUMBER_FIRST,
    DeviceCommands,
)
from madns_runtime.simulations.constellation.vehicle.flight_tick import fit_out, rate_of
from madns_runtime.simulations.constellation.vehicle.stimuli import Stimuli
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer
from madns_runtime.simulations.constellation.vehicles import flight_of, vehicle_of


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
        self._stride = max(1, round(context.tick_hz / parameters.record.elements_hz))
        # A day at 1 Hz is 8 MB an agent: long runs may record less than every tick.
        state_hz = parameters.record.state_hz or context.tick_hz
        self._state_stride = max(1, round(context.tick_hz / state_hz))
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
        self._flight_tick = 0
        self._has_begun = False
        if self._is_commanded:
            context.open_stream("truth_changes", TRUTH_CHANGES)
        self._stimuli = Stimuli(vehicle.stimuli, context, first) if vehicle.stimuli else None

    def step(self, tick: Tick) -> None:
        """
        Record the truth of this tick; a tick without truth is counted and nothing is made up.

        Raises:
            BlamedError: The vehicle has met the Earth.
        """
        # Its ticks lie that much behind their nominal times, and so do its maneuvers.
        self._phase_s = max(0.0, tick.deadline_s - tick.t_s)
        self._step_early(tick)
        state = self._buffer.lookup(tick.t_s)
        if state is not None:
            x, y, z = state[:3]
            if x * x + y * y + z * z < EARTH_POLAR_RADIUS_M**2:
                raise BlamedError(f"{self._satellite} has met the Earth at {tick.t_s:g} s")
            self._record_truth(tick, state)
        self._measure(tick.index, tick.t_s, state)
        if self._cockpit is not None and tick.index >= self._flight_tick:
            # At the first tick at or after each of its times.
            every = self._rate.ticks_per_step
            self._flight_tick = tick.index - tick.index % every + every
            self._cockpit.step(tick.index, tick.t_s, state)
        if self._devices is not None:
            self._devices.step(tick.index, tick.t_s, self._phase_s)
        if self._stimuli is not None:
            self._stimuli.step(tick.t_s)

    def _step_early(self, tick: Tick) -> None:
        """Do the steps of flight software since the tick before, but the one at the tick's own time."""
        cockpit = self._cockpit
        if cockpit is None:
            return
        cockpit.phase_s = self._phase_s
        has_begun, self._has_begun = self._has_begun, True
        # Who has just begun, or rejoined, was not there yet.
        for t_s in self._rate.early_times_s(tick.index) if has_begun else ():
            state = self._buffer.lookup(t_s)
            self._measure(tick.index, t_s, state)
            cockpit.step(tick.index, t_s, state, is_early=True)

    def _measure(self, tick: int, t_s: float, state: tuple[float, ...] | None) -> None:
        if self._sensors is not None:
            self._sensors.step(tick, t_s, state)
            if self._cockpit is not None:
                self._cockpit.take(self._sensors.news())

    def _record_truth(self, tick: Tick, state: tuple[float, ...]) -> None:
        self._served += 1
        if tick.index >= self._state_tick:
            self._state_tick = tick.index - tick.index % self._state_stride + self._state_stride
            self._record_state(tick.index, state)
        if tick.index >= self._elements_tick:
            self._elements_tick = tick.index - tick.index % self._stride + self._stride
            self._record_elements(tick.index, state)

    def _record_state(self, tick: int, state: tuple[float, ...]) -> None:
        x, y, z, vx, vy, vz = state[:6]
        self._context.record(
            "state",
            (
                tick,
                round(x, 6),
                round(y, 6),
                round(z, 6),
                round(vx, 9),
                round(vy, 9),
                round(vz, 9),
            ),
        )
        if len(state) > 6:
            self._context.record("attitude", (tick, *[round(value, 12) for value in state[6:]]))

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
            self._take_result(CommandResult.from_message(message))
        elif kind != CommandResult.KIND:
            raise PluginError(f"constellation: expected a segment, got {message!r:.200}")

    def hear(self, delivery: Delivery) -> None:
        """Take a message by radio; a broadcast also reaches those who fly nothing."""
        if self._cockpit is not None:
            self._cockpit.deliver(delivery)

    def refused(self, refusal: TransmissionRefusal) -> None:
        """Take that a message to others was refused."""
        if self._cockpit is not None:
            self._cockpit.refuse(refusal)

    def _take_result(self, result: CommandResult) -> None:
        if self._devices is not None and result.number >= DEVICE_NUMBER_FIRST:
            self._devices.tell(result)
            if self._cockpit is not None:
                self._cockpit.read_gauges(result)
        elif self._cockpit is not None:
            self._cockpit.tell(result)

    def _take_segment(self, segment: Segment) -> None:
        now_s = self._context.now_s()
        left_s = self._buffer.end_s - now_s
        if self._buffer.add(segment):
            self._left_s_min = min(self._left_s_min, left_s)
        if self._stimuli is not None:
            self._stimuli.take(segment, now_s)
        if segment.revision > self._revision and self._is_commanded:
            self._revision = segment.revision
            left_s = segment.t0_s + self._phase_s - now_s
            self._change_left_s_min = min(self._change_left_s_min, left_s)
            self._context.record("truth_changes", (segment.revision, segment.t0_s, now_s, left_s))

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
            **flown,
            **self._message_counts(),
            "checks": [underruns, *(checks if isinstance(checks, list) else [checks])],
        }

    def _stimuli_summary(self) -> dict[str, Any]:
        stimuli = self._stimuli
        return {} if stimuli is None else {"stimuli": stimuli.finish(self._context.now_s())}

    def _message_counts(self) -> dict[str, int]:
        """Return the counts of messages by radio; without flight software nobody heard them."""
        counts = self._context.message_counts()
        if self._cockpit is None:
            return {
                "messages_unheard": sum(counts[name] for name in ("received", "held", "no_room"))
            }
        return {
            "messages_received": counts["received"],
            "messages_held": counts["held"],
            "messages_late": counts["late"],
            "messages_refused": counts["no_room"],
            "messages_unheard": 0,
        }

    def _record_elements(self, tick: int, state: tuple[float, ...]) -> None:
        x, y, z, vx, vy, vz = state[:6]
        try:
            elements = elements_from_state((x, y, z), (vx, vy, vz), self._mu_m3_s2)
        except ValueError:
            return  # an escape orbit has none of these
        self._context.record(
            "elements",
            (
                tick,
                round(elements.a_m, 3),
                round(elements.e, 10),
                round(math.degrees(elements.i_rad), 8),
                round(math.degrees(elements.raan_rad), 8),
                round(math.degrees(elements.argp_rad), 7),
                round(math.degrees(elements.mean_anomaly_rad), 7),
            ),
        )
