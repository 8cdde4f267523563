"""
Truth that a vehicle's devices are given: computed ahead, in the device's axes, and handed over as timed profiles.

A new revision of truth replaces the future of what was handed over. Whether a point was put out in time is the
device's process to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import AgentContext, DeviceView
from madns_runtime.simulations.constellation.equipment import Magnetometer
from madns_runtime.simulations.constellation.messages import Initial, Segment
from madns_runtime.simulations.constellation.orbit.constants import (
    GRAVITY_MODELS,
    SECONDS_PER_DAY,
)
from madns_runtime.simulations.constellation.orbit.earth import gmst_rad, gmst_rate_rad_s
from madns_runtime.simulations.constellation.orbit.quaternions import (
    multiply,
    normalised,
    rotate,
)
from madns_runtime.simulations.constellation.stimulus import SOURCES, Stimulus
from madns_runtime.simulations.constellation.vehicle.future_truth import FutureTruth
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import FluxGate
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer

J2000_UNIX_S = 946_728_000.0
"""2000-01-01 12:00 UTC, s since 1970."""
PARTS = 4
"""Of its lead, so much is handed over at once: less would cost a message per tick."""
GRID_ROUNDING = 1e-9

Values = tuple[float, ...]


class Stimuli:
    """
    All stimuli of one vehicle.

    Args:
        settings: Of each.
        context: Of the agent.
        initial: The first message to it.

    Raises:
        PluginError: The agent uses no such device, or it has no such output for that many numbers.
        MissingExtraError: The field model is not installed.
    """

    def __init__(
        self, settings: Sequence[Stimulus], context: AgentContext, initial: Initial
    ) -> None:
        self._truth = FutureTruth()
        self._players = [
            StimulusPlayer(each, context, epoch_utc=initial.epoch_utc, truth=self._truth)
            for each in settings
        ]
        self._revision = 0
        self._wake_s = -math.inf
        for segment in (initial.segment, *initial.more):
            if segment is not None:
                self._truth.add(segment)
                self._revision = max(self._revision, segment.revision)
        if initial.segment is not None and initial.segment.t0_s <= 0.0:
            self._fill(0.0)  # before time runs; who rejoins begins with its first tick

    def take(self, segment: Segment, now_s: float) -> None:
        """Take truth; what it changes of what was handed over is replaced at once."""
        self._truth.forget(now_s)
        self._wake_s = -math.inf
        if self._truth.add(segment):
            for player in self._players:
                if player.is_changed(segment, is_newer=segment.revision > self._revision):
                    player.fill(now_s)
        self._revision = max(self._revision, segment.revision)

    def step(self, t_s: float) -> None:
        """Hand over what is wanted by now; most ticks find nothing to do."""
        if t_s >= self._wake_s:
            self._fill(t_s)

    def _fill(self, t_s: float) -> None:
        self._wake_s = min(player.fill(t_s) for player in self._players)

    def finish(self, t_s: float) -> dict[str, Any]:
        """End all profiles, and return their summary by channel; segments of truth that none could use are counted."""
        told = {player.name: player.finish(t_s) for player in self._players}
        return {
            name: {**counts, "segments_refused": self._truth.refused}
            for name, counts in told.items()
        }


class StimulusPlayer:
    """
    One stimulus.

    Args:
        settings: Of it.
        context: Of the agent.
        epoch_utc: UTC of simulated time zero.
        truth: The vehicle's.

    Raises:
        PluginError: See `Stimuli`.
        MissingExtraError: See `Stimuli`.
    """

    def __init__(
        self, settings: Stimulus, context: AgentContext, *, epoch_utc: str, truth: FutureTruth
    ) -> None:
        self.name = settings.channel
        self._settings = settings
        self._device: DeviceView = context.hardware[settings.device]
        size, wanted = self._device.size_of(settings.output), SOURCES[settings.source].size
        if size != wanted:
            raise PluginError(
                f"stimulus {settings.source}: {settings.channel} takes {size} numbers, and these are {wanted}"
            )
        self._truth = truth
        gravity = GRAVITY_MODELS[context.parameters.gravity]
        self._scene = Scene(epoch_utc, TruthBuffer(), gravity.radius_m)  # nothing here feels pushes
        self._measure = _source(settings, self._scene)
        self._transform = transform_of(settings)
        self._next = math.ceil(settings.start_s * settings.rate_hz - GRID_ROUNDING)
        """Number of the next point, counted from simulated time zero."""
        self._from_s: float | None = None
        """Time from which on what was handed over is to be replaced, s."""
        self._end_s = context.duration_s
        self._points = self._saturated = self._omitted = self._replacements = 0

    def is_changed(self, segment: Segment, *, is_newer: bool) -> bool:
        """Take note of new truth, and tell whether it changes what was handed over."""
        rate_hz = self._settings.rate_hz
        # Where segments of one revision meet they say the same.
        margin_s = GRID_ROUNDING if is_newer else -GRID_ROUNDING
        if not self._points or segment.t0_s > (self._next - 1) / rate_hz + margin_s:
            return False
        self._replacements += 1
        self._from_s = min(segment.t0_s, math.inf if self._from_s is None else self._from_s)
        first = math.ceil(max(segment.t0_s, self._settings.start_s) * rate_hz - GRID_ROUNDING)
        self._next = min(self._next, first)
        return True

    def fill(self, t_s: float) -> float:
        """Hand over points up to the lead, as far as there is truth, and return when it is wanted again, s."""
        settings, rate_hz = self._settings, self._settings.rate_hz
        # The newest that is past is still worth it: it holds until the next.
        first = math.floor(t_s * rate_hz + GRID_ROUNDING)
        if first > self._next:
            self._omitted += (first - self._next) * bool(self._points)
            self._next = first
        until_s = min(t_s + settings.lead_s, self._truth.end_s, self._end_s) + GRID_ROUNDING
        points = []
        while (at_s := self._next / rate_hz) <= until_s:
            state = self._truth.lookup(at_s)
            if state is None:
                break  # a segment before this one is still on its way
            self._scene.move(at_s, state)
            points.append((at_s, self._value()))
            self._next += 1
        if points or self._from_s is not None:
            from_s = self._from_s
            if from_s is not None and points:
                # A point at that time may lie before it by a rounding.
                from_s = min(from_s, points[0][0])
            self._device.play(settings.output, points, from_s=from_s)
            self._points += len(points)
            self._from_s = None
            if (next_s := self._next / rate_hz) > self._end_s + GRID_ROUNDING:
                # The run ends: none is missing.
                self._device.play(settings.output, (), from_s=next_s)
        return (self._next - 1) / rate_hz - settings.lead_s * (1.0 - 1.0 / PARTS)

    def _value(self) -> Values:
        values = self._transform(self._measure(self._scene))
        limits = self._settings.limits
        if limits is None:
            return values
        low, high = limits
        held = tuple(min(max(value, low), high) for value in values)
        self._saturated += held != values
        return held

    def finish(self, t_s: float) -> dict[str, int]:
        """End the profile in good order, and return what was handed over."""
        self._device.play(self._settings.output, (), from_s=t_s)
        return {
            "points": self._points,
            "saturated": self._saturated,
            "omitted": self._omitted,
            "replacements": self._replacements,
        }


def transform_of(settings: Stimulus) -> Callable[[Values], Values]:
    """Return the function from a source's values to the channel's, before their limits."""
    size = SOURCES[settings.source].size
    scale = settings.scale if isinstance(settings.scale, tuple) else (settings.scale,) * size
    bias = settings.bias if isinstance(settings.bias, tuple) else (settings.bias,) * size
    align = _alignment(settings)
    if all(factor == 1.0 for factor in scale) and not any(bias):
        return align

    def transform(values: Values) -> Values:
        aligned = align(values)
        return tuple(k * v + b for k, v, b in zip(scale, aligned, bias, strict=True))

    return transform


def _alignment(settings: Stimulus) -> Callable[[Values], Values]:
    alignment = settings.alignment
    if alignment is None:
        return _unchanged
    if len(alignment) == 4:
        turn = normalised(alignment)
        if settings.source == "quaternion":
            return lambda values: multiply(values, turn)
        return lambda values: rotate(turn, values)
    (a, b, c), (d, e, f), (g, h, i) = alignment

    def align(values: Values) -> Values:
        x, y, z = values
        return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z

    return align


def _unchanged(values: Values) -> Values:
    return values


def _source(settings: Stimulus, scene: Scene) -> Callable[[Scene], Values]:
    """
    Return the function from a vehicle's truth and surroundings to a source's values.

    Raises:
        MissingExtraError: The field model is not installed.
    """
    if settings.source == "magnetic_field":
        gate = FluxGate(Magnetometer(field=settings.field), scene)
        return lambda scene: gate.measure(scene, [0.0, 0.0, 0.0])
    return _SOURCES[settings.source]


def _sun_direction(scene: Scene) -> Values:
    direction = scene.sun_direction()
    return (0.0, 0.0, 0.0) if direction is None else scene.to_body(direction)


def earth_fixed_state(scene: Scene) -> Values:
    """
    Return position, m, and velocity, m/s, in the Earth-fixed frame of the WGS-84 ellipsoid.

    TEME is turned by Greenwich mean sidereal time alone, UTC standing for UT1: see `orbit.earth` for what that leaves out.
    """
    x, y, z, vx, vy, vz = scene.state[:6]
    gmst, rate_rad_s = gmst_rad(scene.days), gmst_rate_rad_s(scene.days)
    cosine, sine = math.cos(gmst), math.sin(gmst)
    x, y = cosine * x + sine * y, cosine * y - sine * x
    vx, vy = cosine * vx + sine * vy, cosine * vy - sine * vx
    return x, y, z, vx + rate_rad_s * y, vy - rate_rad_s * x, vz


def gnss_epoch(scene: Scene) -> Values:
    """Return UTC, s since 1970 without leap seconds, and the Earth-fixed state."""
    return (scene.days * SECONDS_PER_DAY + J2000_UNIX_S, *earth_fixed_state(scene))


_SOURCES: dict[str, Callable[[Scene], Values]] = {
    "sun_direction": _sun_direction,
    "body_rates": lambda scene: scene.state[10:13],
    "quaternion": lambda scene: scene.state[6:10],
    "position": lambda scene: scene.state[:3],
    "velocity": lambda scene: scene.state[3:6],
    "earth_fixed_state": earth_fixed_state,
    "gnss_epoch": gnss_epoch,
}
