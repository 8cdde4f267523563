"""
All sensors of one vehicle, and the parts that they share: rate, errors, latency, dropout and records.

An instrument measures; a `Sensor` decides when, with which errors, and when flight software hears of it. A
`DeviceSensor` stands in its place where the scenario names a device.
"""

from __future__ import annotations

import math
from collections import deque

from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.actions import SensorFault
from madns_runtime.simulations.constellation.equipment import (
    Magnetometer,
    MagnetometerDevice,
    SensorNoise,
    Sensors,
)
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.streams import OF_AGENTS
from madns_runtime.simulations.constellation.vehicle.sensors.channel_source import ChannelSource
from madns_runtime.simulations.constellation.vehicle.sensors.device_sensor import DeviceSensor
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import (
    Accelerometer,
    FluxGate,
    Instrument,
    clock,
    gnss,
    gyro,
    star_tracker,
    sun_sensor,
)
from madns_runtime.simulations.constellation.vehicle.sensors.sensor_errors import (
    Errors,
    error_model,
    key_of,
)
from madns_runtime.simulations.constellation.vehicle.sensors.sensor_failures import (
    SensorFailures,
)
from madns_runtime.simulations.constellation.vehicle.sensors.truth_beside import (
    TruthBeside,
    TruthOfTicks,
)

TIME_EPSILON_S = 1e-9
"""Rounding of times."""
SAMPLE_EPSILON = 1e-6
"""Rounding of a sample's number: of a tick's time times a rate, also after days."""
REJOIN_S = 1.0
"""Largest lead of a clock over the first tick, s."""
PENDING_MAX = 10_000
"""Measurements under way to flight software; further ones are dropped and counted."""


class Sensor:
    """
    An instrument at its rate.

    Args:
        instrument: What measures.
        settings: From the scenario.
        context: Where the stream is recorded.
        chance: What the run's seed gave to the agent.
        step_hz: How often it may measure; None for once per tick.
    """

    def __init__(
        self,
        instrument: Instrument,
        settings: SensorNoise,
        *,
        context: AgentContext,
        chance: bytes,
        step_hz: float | None = None,
    ) -> None:
        self.name = instrument.name
        self.samples = 0
        """Measurements handed out."""
        self.news: list[Reading] = []
        """All that became known when it was read last."""
        self.dropped = 0
        """Measurements that never came: dropouts, and those for which there was no room."""
        self.blind = 0
        """Measurements with nothing to measure."""
        self.failures = SensorFailures(is_unit=instrument.is_unit)
        self._measure = instrument.measure
        # Faster than that, its samples would be numbers that nobody measures.
        self._rate_hz = min(settings.rate_hz, step_hz or context.tick_hz)
        self._latency_s = settings.latency_s
        self._digits = instrument.digits
        self._record = context.record
        self._stream = instrument.stream or instrument.name
        self._number = -1
        self._pending: deque[tuple[float, Reading]] = deque()
        model = error_model(settings, instrument.channels, period_s=1.0 / self._rate_hz)
        self._errors = Errors(model, key_of(chance, f"sensor {self.name}"))
        # In a vehicle that rejoins, biases walk here to where they are by now: a tick has no time for that.
        self._errors.at(max(0, math.floor((context.now_s() - REJOIN_S) * self._rate_hz)))
        context.open_stream(self._stream, OF_AGENTS[self._stream])

    def sample(self, scene: Scene) -> None:
        """Measure if it is time to: at most once per call."""
        number = math.floor(scene.t_s * self._rate_hz + SAMPLE_EPSILON)
        if number <= self._number:
            return
        self._number = number
        error = self._errors.at(number)
        # One that never comes is not taken: what an accelerometer has felt meanwhile is in the next.
        if error is None or self.failures.is_dead or len(self._pending) >= PENDING_MAX:
            self.dropped += 1
            return
        values = self._measure(scene, error)
        if values is not None and self.failures:
            values = self.failures.altered(values)
        if values is None:
            self.blind += 1
            return
        self._pending.append((scene.t_s + self._latency_s, Reading(scene.t_s, values)))

    def counts(self) -> dict[str, int]:
        """Return what became of its measurements."""
        counts = {"samples": self.samples, "dropped": self.dropped, "blind": self.blind}
        under_way = len(self._pending)
        return counts | ({"under_way": under_way} if under_way else {})

    def read(self, tick: int, t_s: float) -> Reading | None:
        """Return the newest measurement that has become known by *t_s*, and record all that have."""
        pending, newest = self._pending, None
        self.news = []
        while pending and pending[0][0] <= t_s + TIME_EPSILON_S:
            newest = pending.popleft()[1]
            self.samples += 1
            self.news.append(newest)
            digits = self._digits
            self._record(
                self._stream, (tick, newest.t_s, *[round(value, digits) for value in newest.values])
            )
        return newest


class SensorSuite:
    """
    All sensors of one vehicle, read together.

    Args:
        settings: From the scenario.
        scene: The vehicle's surroundings.
        context: Where measurements are recorded.
        chance: What the run's seed gave to the agent.
        step_hz: How often it is asked; None for once per tick.

    Raises:
        MissingExtraError: The IGRF is wanted and not installed.
        PluginError: A device or its channel is not there, or measures something else.
    """

    def __init__(
        self,
        settings: Sensors,
        scene: Scene,
        *,
        context: AgentContext,
        chance: bytes,
        step_hz: float | None = None,
    ) -> None:
        self._scene = scene
        self._feels = settings.accelerometer is not None
        self._accelerometer = Accelerometer()
        instruments = [
            Instrument(name="gnss", measure=gnss, digits=6, channels=6),
            Instrument(name="gyro", measure=gyro, digits=12),
            Instrument(
                name="accelerometer",
                measure=self._accelerometer.measure,
                digits=12,
                is_mean=True,
            ),
            Instrument(name="star_tracker", measure=star_tracker, digits=12, is_unit=True),
            Instrument(name="sun_sensor", measure=sun_sensor, digits=9, is_unit=True),
            # The stream clock is the framework's own.
            Instrument(name="clock", stream="clock_sensor", measure=clock, digits=12, channels=1),
        ]
        if settings.magnetometer is not None:
            of_field = settings.magnetometer
            if isinstance(of_field, MagnetometerDevice):
                of_field = of_field.model or Magnetometer()
            measure = FluxGate(of_field, scene).measure
            instruments.append(Instrument(name="magnetometer", measure=measure, digits=15))
        self._history = TruthOfTicks()
        self._models: list[Sensor] = []
        self._sensors: list[Sensor | DeviceSensor] = []
        for instrument in instruments:
            wanted = getattr(settings, instrument.name)
            if isinstance(wanted, SensorNoise):
                self._models.append(
                    Sensor(instrument, wanted, context=context, chance=chance, step_hz=step_hz)
                )
                self._sensors.append(self._models[-1])
            elif wanted is not None:
                source = ChannelSource(instrument.name, wanted, context=context, scene=scene)
                beside = TruthBeside(instrument, wanted.model, context=context, chance=chance)
                self._sensors.append(
                    DeviceSensor(
                        instrument,
                        source,
                        beside,
                        context=context,
                        surroundings=(scene, self._history),
                    )
                )
        self._has_devices = len(self._models) < len(self._sensors)

    def step(self, tick: int, t_s: float, state: tuple[float, ...] | None) -> dict[str, Reading]:
        """
        Measure what is due, and return by sensor what has become known; without truth nothing is measured.

        Args:
            tick: Its number.
            t_s: Its time.
            state: Truth, or None.
        """
        if state is not None:
            self._scene.move(t_s, state)
            if self._feels:
                self._accelerometer.feel(self._scene)
            if self._has_devices:
                self._history.add(t_s, state)
            for sensor in self._models:
                sensor.sample(self._scene)
        readings = {sensor.name: sensor.read(tick, t_s) for sensor in self._sensors}
        return {name: reading for name, reading in readings.items() if reading is not None}

    def begin_failure(self, number: int, fault: SensorFault) -> str:
        """Put a failure of a modelled sensor in force; return why it cannot be, or ""."""
        for sensor in self._models:
            if sensor.name == fault.sensor:
                sensor.failures.begin(number, fault)
                return ""
        known = ", ".join(sensor.name for sensor in self._models) or "none"
        return f"this vehicle models no {fault.sensor}; it models {known}"

    def end_failure(self, number: int) -> None:
        """Lift a failure."""
        for sensor in self._models:
            sensor.failures.end(number)

    def news(self) -> dict[str, list[Reading]]:
        """Return by sensor all that became known in the last step, oldest first."""
        return {sensor.name: sensor.news for sensor in self._sensors if sensor.news}

    def silent(self) -> list[str] | None:
        """Return the sensors whose devices were there and which gave no reading at all; None where all are models."""
        if not self._has_devices:
            return None
        devices = (sensor for sensor in self._sensors if isinstance(sensor, DeviceSensor))
        return [sensor.name for sensor in devices if sensor.is_silent]

    def summary(self) -> dict[str, dict[str, int]]:
        """Return counts by sensor."""
        return {sensor.name: sensor.counts() for sensor in self._sensors}
