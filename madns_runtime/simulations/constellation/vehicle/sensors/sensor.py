"""
What all sensors share: rate, errors, latency, dropout and records.

An instrument measures; a `Sensor` decides when, with which errors, and when flight software hears of it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Protocol

from madns_runtime.plugin.api import AgentContext
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.equipment import SensorNoise
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.vehicle.sensors.errors import (
    ErrorModel,
    Errors,
    Row,
    key_of,
)
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene

TIME_EPSILON_S = 1e-9
"""Rounding of times."""
SAMPLE_EPSILON = 1e-6
"""Rounding of a sample's number: of a tick's time times a rate, also after days."""
REJOIN_S = 1.0
"""What a clock may be ahead of the first tick."""
PENDING_MAX = 10_000
"""Measurements under way to flight software; further ones are dropped and counted."""


class Instrument(Protocol):
    """What one kind of sensor is."""

    @property
    def name(self) -> str:
        """Of the reading."""

    @property
    def stream(self) -> str:
        """Of the records."""

    @property
    def fields(self) -> tuple[Field, ...]:
        """Of its values."""

    @property
    def digits(self) -> int:
        """Decimals of the recorded values: beyond them lies nothing but noise of the sensor."""

    @property
    def channels(self) -> int:
        """Errors that a measurement needs."""

    def measure(self, scene: Scene, error: Row) -> tuple[float, ...] | None:
        """Return the measured values, or None if there is nothing to measure, such as no Sun."""


class Sensor:
    """
    An instrument at its rate.

    Args:
        instrument: What measures.
        settings: From the scenario.
        context: Where the stream is recorded.
        chance: What the run's seed gave to the agent.
        white: Standard deviation of white noise, channel by channel; none for the settings' noise on all.
        bias: Which channels have biases; none for all.
    """

    def __init__(  # noqa: PLR0913 - two are for the odd instrument
        self,
        instrument: Instrument,
        settings: SensorNoise,
        *,
        context: AgentContext,
        chance: bytes,
        white: tuple[float, ...] | None = None,
        bias: tuple[bool, ...] | None = None,
    ) -> None:
        count = instrument.channels
        has_bias = bias or (True,) * count
        self.name = instrument.name
        self.samples = 0
        """Measurements handed out."""
        self.dropped = 0
        """Measurements that never came: dropouts, and those for which there was no room."""
        self.blind = 0
        """Measurements with nothing to measure."""
        self._measure: Callable[[Scene, Row], tuple[float, ...] | None] = instrument.measure
        # Faster than the ticks, its samples would be numbers that nobody measures.
        self._rate_hz = min(settings.rate_hz, context.tick_hz)
        self._latency_s = settings.latency_s
        self._digits = instrument.digits
        self._record = context.record
        self._stream = instrument.stream
        self._number = -1
        self._pending: deque[tuple[float, Reading]] = deque()
        model = ErrorModel(
            white=white or (settings.noise,) * count,
            bias=tuple(settings.bias if has else 0.0 for has in has_bias),
            walk=tuple(settings.bias_walk if has else 0.0 for has in has_bias),
            dropout=settings.dropout,
            period_s=1.0 / self._rate_hz,
        )
        self._errors = Errors(model, key_of(chance, f"sensor {self.name}"))
        # In a vehicle that rejoins, biases walk here to where they are by now: a tick has no time for that.
        self._errors.at(max(0, math.floor((context.now_s() - REJOIN_S) * self._rate_hz)))
        fields = (Field("tick", "", "int"), Field("t_s", "s"), *instrument.fields)
        context.open_stream(self._stream, fields)

    def sample(self, scene: Scene) -> None:
        """Measure if it is time to: once a tick at most."""
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
