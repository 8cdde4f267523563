"""
Values that an instrument without errors, and the model of one, would have measured at the time of a device's sample.

A sample's time lies between ticks, and may lie behind the last one: truth of ticks that were served is kept for a
while, and interpolated as between knots. An impulse between two ticks is not seen in it.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import Literal

from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.equipment import SensorNoise
from madns_runtime.simulations.constellation.orbit.interpolation import (
    coefficients,
    evaluate,
    evaluate_turn,
    turn_between,
)
from madns_runtime.simulations.constellation.streams import OF_AGENTS
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import (
    Instrument,
    Measured,
)
from madns_runtime.simulations.constellation.vehicle.sensors.sensor_errors import (
    Errors,
    error_model,
    key_of,
)

TICKS_MAX = 1024
"""Ticks of which truth is kept."""
PENDING_MAX = 1024
"""Samples that may wait for truth; the oldest is given up beyond, and counted."""
GAP_S_MAX = 60.0
TURN_RAD_MAX = 1.0
"""Between two ticks: what lies further apart, or turns further, is not interpolated."""
SAME_INSTANT_S = 1e-9
REJOIN_S = 1.0
"""Largest lead of a clock over the first tick, s."""

State = tuple[float, ...]


class TruthOfTicks:
    """Truth at the last ticks that had any, in order of time."""

    def __init__(self) -> None:
        self._ticks: deque[tuple[float, State]] = deque(maxlen=TICKS_MAX)

    @property
    def newest_s(self) -> float:
        """Time of the last truth, s; minus infinity if there is none."""
        return self._ticks[-1][0] if self._ticks else -math.inf

    def add(self, t_s: float, state: State) -> None:
        """Take the truth of a tick."""
        self._ticks.append((t_s, state))

    def at(self, t_s: float) -> State | None:
        """Return truth at a time that is no later than `newest_s`; None if it cannot be told any more."""
        for later, earlier in pairwise(reversed(self._ticks)):
            if abs(later[0] - t_s) <= SAME_INSTANT_S:
                return later[1]
            if earlier[0] < t_s:
                return _between(earlier, later, t_s)
        if self._ticks and abs(self._ticks[0][0] - t_s) <= SAME_INSTANT_S:
            return self._ticks[0][1]
        return None


def _between(earlier: tuple[float, State], later: tuple[float, State], t_s: float) -> State | None:
    (start_s, first), (end_s, second) = earlier, later
    step_s = end_s - start_s
    if step_s > GAP_S_MAX:
        return None
    part = (t_s - start_s) / step_s
    orbit = evaluate(coefficients(first[:6], second[:6], step_s), part, step_s)
    if len(first) <= 6:
        return orbit
    if math.hypot(*first[10:13]) * step_s > TURN_RAD_MAX:
        return None
    return orbit + evaluate_turn(turn_between(first[6:], second[6:], step_s), part, step_s)


class TruthBeside:
    """
    Records of truth and model beside the readings of one sensor that is hardware.

    Args:
        instrument: Its model.
        model: Errors of the model; None for no model.
        context: Where both are recorded.
        chance: What the run's seed gave to the agent.
    """

    def __init__(
        self,
        instrument: Instrument,
        model: SensorNoise | None,
        *,
        context: AgentContext,
        chance: bytes,
    ) -> None:
        self._instrument = instrument
        self._context = context
        self._pending: deque[tuple[int, float]] = deque()
        self._none = [0.0] * instrument.channels
        self.without_truth = 0
        """Readings at whose time no truth was to be had."""
        self._errors: Errors | None = None
        self._stream = instrument.stream or instrument.name
        self._open("truth")
        if model is not None:
            period_s = 1.0 / context.tick_hz
            errors = error_model(model, instrument.channels, period_s=period_s)
            self._errors = Errors(errors, key_of(chance, f"sensor {instrument.name}"))
            self._errors.at(max(0, math.floor((context.now_s() - REJOIN_S) * context.tick_hz)))
            self._open("model")

    @property
    def waiting(self) -> int:
        """Readings whose truth is still to come."""
        return len(self._pending)

    def add(self, tick: int, t_s: float) -> None:
        """Take that a reading of this time was handed out in a tick."""
        if len(self._pending) == PENDING_MAX:
            self._pending.popleft()
            self.without_truth += 1
        self._pending.append((tick, t_s))

    def settle(self, history: TruthOfTicks, scene: Scene) -> None:
        """Record what is known by now; *scene* is moved, and left as it was."""
        pending, before = self._pending, (scene.t_s, scene.state)
        while pending and pending[0][1] <= history.newest_s + SAME_INSTANT_S:
            tick, t_s = pending.popleft()
            state = history.at(t_s)
            if state is None:
                self.without_truth += 1
                continue
            scene.move(t_s, state)
            self._record(tick, scene)
        scene.move(*before)

    def settle_now(self, tick: int, scene: Scene, t_s: float) -> None:
        """Record the same of an instrument that measures what was since its last measurement, at the tick itself."""
        if abs(scene.t_s - t_s) <= SAME_INSTANT_S:
            self._record(tick, scene)
        else:
            self.without_truth += 1

    def _record(self, tick: int, scene: Scene) -> None:
        measure = self._instrument.measure
        truth = measure(scene, self._none)
        if truth is None:
            self.without_truth += 1
            return
        self._write("truth", tick, scene.t_s, truth)
        error = None if self._errors is None else self._errors.at(tick)
        if error is None:
            return
        if self._instrument.is_mean:
            modelled: Measured | None = tuple(a + b for a, b in zip(truth, error, strict=True))
        else:
            modelled = measure(scene, error)
        if modelled is not None:
            self._write("model", tick, scene.t_s, modelled)

    def _open(self, kind: Literal["truth", "model"]) -> None:
        name = f"{self._stream}_{kind}"
        self._context.open_stream(name, OF_AGENTS[name])

    def _write(
        self, kind: Literal["truth", "model"], tick: int, t_s: float, values: Measured
    ) -> None:
        digits = self._instrument.digits
        row = (tick, t_s, *[round(value, digits) for value in values])
        self._context.record(f"{self._stream}_{kind}", row)
