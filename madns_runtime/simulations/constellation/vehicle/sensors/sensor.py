"""
All sensors of one vehicle, and the parts that they share: rate, errors, latency, dropout and records.

An instrument measures; a `Sensor` decides when, with which errors, and when flight software hears of it. Errors are
white noise, a constant bias, a bias that walks, and samples that never come.

A sample's error depends on its number alone: not on the samples before it, not on other sensors, not on
ticks that were skipped or on how often the agent was started. Random numbers come in blocks, each from
a counter-based generator that is set to the block's number.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.equipment import Gnss, SensorNoise, Sensors
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.streams import OF_AGENTS
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import (
    Accelerometer,
    FluxGate,
    Instrument,
    Row,
    clock,
    gnss,
    gyro,
    star_tracker,
    sun_sensor,
)

TIME_EPSILON_S = 1e-9
"""Rounding of times."""
SAMPLE_EPSILON = 1e-6
"""Rounding of a sample's number: of a tick's time times a rate, also after days."""
REJOIN_S = 1.0
"""Largest lead of a clock over the first tick, s."""
PENDING_MAX = 10_000
"""Measurements under way to flight software; further ones are dropped and counted."""

BLOCK = 256
"""Samples whose errors are drawn at a time."""


class Sensor:
    """
    An instrument at its rate.

    Args:
        instrument: What measures.
        settings: From the scenario.
        context: Where the stream is recorded.
        chance: What the run's seed gave to the agent.
    """

    def __init__(
        self,
        instrument: Instrument,
        settings: SensorNoise,
        *,
        context: AgentContext,
        chance: bytes,
    ) -> None:
        self.name = instrument.name
        self.samples = 0
        """Measurements handed out."""
        self.dropped = 0
        """Measurements that never came: dropouts, and those for which there was no room."""
        self.blind = 0
        """Measurements with nothing to measure."""
        self._measure = instrument.measure
        # Faster than the ticks, its samples would be numbers that nobody measures.
        self._rate_hz = min(settings.rate_hz, context.tick_hz)
        self._latency_s = settings.latency_s
        self._digits = instrument.digits
        self._record = context.record
        self._stream = instrument.stream or instrument.name
        self._number = -1
        self._pending: deque[tuple[float, Reading]] = deque()
        # A receiver's velocity has a noise of its own, and no bias.
        of_velocity = (settings.velocity_noise_m_s,) * 3 if isinstance(settings, Gnss) else ()
        others, unbiased = instrument.channels - len(of_velocity), (0.0,) * len(of_velocity)
        model = ErrorModel(
            white=(settings.noise,) * others + of_velocity,
            bias=(settings.bias,) * others + unbiased,
            walk=(settings.bias_walk,) * others + unbiased,
            dropout=settings.dropout,
            period_s=1.0 / self._rate_hz,
        )
        self._errors = Errors(model, key_of(chance, f"sensor {self.name}"))
        # In a vehicle that rejoins, biases walk here to where they are by now: a tick has no time for that.
        self._errors.at(max(0, math.floor((context.now_s() - REJOIN_S) * self._rate_hz)))
        context.open_stream(self._stream, OF_AGENTS[self._stream])

    def sample(self, scene: Scene) -> None:
        """Measure if it is time to: at most once per tick."""
        number = math.floor(scene.t_s * self._rate_hz + SAMPLE_EPSILON)
        if number <= self._number:
            return
        self._number = number
        error = self._errors.at(number)
        if error is None or len(self._pending) >= PENDING_MAX:
            self.dropped += 1
            return
        values = self._measure(scene, error)
        if values is None:
            self.blind += 1
            return
        self._pending.append((scene.t_s + self._latency_s, Reading(scene.t_s, values)))

    def read(self, tick: int, t_s: float) -> Reading | None:
        """Return the newest measurement that has become known by *t_s*, and record all that have."""
        pending, newest = self._pending, None
        while pending and pending[0][0] <= t_s + TIME_EPSILON_S:
            newest = pending.popleft()[1]
            self.samples += 1
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

    Raises:
        MissingExtraError: The IGRF is wanted and not installed.
    """

    def __init__(
        self, settings: Sensors, scene: Scene, *, context: AgentContext, chance: bytes
    ) -> None:
        self._scene = scene
        self._feels = settings.accelerometer is not None
        self._accelerometer = Accelerometer()
        instruments = [
            Instrument(name="gnss", measure=gnss, digits=6, channels=6),
            Instrument(name="gyro", measure=gyro, digits=12),
            Instrument(name="accelerometer", measure=self._accelerometer.measure, digits=12),
            Instrument(name="star_tracker", measure=star_tracker, digits=12),
            Instrument(name="sun_sensor", measure=sun_sensor, digits=9),
            # The stream clock is the framework's own.
            Instrument(name="clock", stream="clock_sensor", measure=clock, digits=12, channels=1),
        ]
        if settings.magnetometer is not None:
            measure = FluxGate(settings.magnetometer, scene).measure
            instruments.append(Instrument(name="magnetometer", measure=measure, digits=15))
        self._sensors = [
            Sensor(instrument, wanted, context=context, chance=chance)
            for instrument in instruments
            if (wanted := getattr(settings, instrument.name)) is not None
        ]

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
            for sensor in self._sensors:
                sensor.sample(self._scene)
        readings = {sensor.name: sensor.read(tick, t_s) for sensor in self._sensors}
        return {name: reading for name, reading in readings.items() if reading is not None}

    def summary(self) -> dict[str, dict[str, int]]:
        """Return counts by sensor."""
        return {
            sensor.name: {
                "samples": sensor.samples,
                "dropped": sensor.dropped,
                "blind": sensor.blind,
            }
            for sensor in self._sensors
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorModel:
    """Standard deviations of each value's errors, in the value's unit."""

    white: tuple[float, ...]
    bias: tuple[float, ...]
    walk: tuple[float, ...]
    """Over one square root of a second."""
    dropout: float
    """Share of samples that never come."""
    period_s: float
    """Between samples, s."""


class Errors:
    """
    The errors of one sensor, sample by sample; numbers only grow.

    Args:
        model: What they are like.
        key: 16 bytes that no other sensor of the run has; see `key_of`.
    """

    def __init__(self, model: ErrorModel, key: bytes) -> None:
        self._model = model
        self._key = np.frombuffer(key, dtype=np.uint64)
        self._width = len(model.white)
        self._bias = self._generator(0).standard_normal(self._width) * np.asarray(model.bias)
        self._walk_step = np.asarray(model.walk) * np.sqrt(model.period_s)
        self._walks = bool(self._walk_step.any())
        self._walked = np.zeros(self._width)
        self._block = -1
        self._rows: list[Row | None] = []

    def at(self, number: int) -> Row | None:
        """
        Return the errors of sample *number*, one for each value; None for a sample that never comes.

        Numbers must not fall below the block of an earlier call.
        """
        block, place = divmod(number, BLOCK)
        if block != self._block:
            self._rows = self._draw(block)
        return self._rows[place]

    def _draw(self, block: int) -> list[Row | None]:
        if self._walks:
            for skipped in range(self._block + 1, block):
                self._walked += self._draws(skipped)[2].sum(axis=0)
        white, chances, steps = self._draws(block)
        errors = white + self._bias
        if self._walks:
            # The walk begins at zero: a sample has the steps before it.
            errors += self._walked + np.cumsum(steps, axis=0) - steps
            self._walked = self._walked + steps.sum(axis=0)
        self._block = block
        rows: list[Row | None] = errors.tolist()
        for place in np.flatnonzero(chances < self._model.dropout).tolist():
            rows[place] = None
        return rows

    def _draws(self, block: int) -> tuple[NDArray[np.float64], ...]:
        """Return white noise, chances and steps of a block; none of them depends on a setting of another."""
        generator = self._generator(block + 1)
        white = generator.standard_normal((BLOCK, self._width)) * self._model.white
        chances = generator.random(BLOCK)
        if not self._walks:
            return white, chances, white
        return white, chances, generator.standard_normal((BLOCK, self._width)) * self._walk_step

    def _generator(self, block: int) -> np.random.Generator:
        # The low words count the draws within a block.
        counter = np.array([0, 0, 0, block], dtype=np.uint64)
        return np.random.Generator(np.random.Philox(key=self._key, counter=counter))


def key_of(chance: bytes, name: str) -> bytes:
    """Return a key of one's own for whatever has *name*, from what the run's seed gave to the agent."""
    return hashlib.blake2b(name.encode(), key=chance, digest_size=16).digest()


def generator_of(chance: bytes, name: str) -> np.random.Generator:
    """Return a generator of one's own for whatever has *name*."""
    key: Any = np.frombuffer(key_of(chance, name), dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))
