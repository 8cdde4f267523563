"""Readings from a device's channels: the newest sample, each once, corrected and in the sensor's unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from madns_runtime.errors import PluginError
from madns_runtime.hardware.units import factor_of, unit_fault
from madns_runtime.plugin.api import AgentContext, ChannelReading, DeviceView
from madns_runtime.simulations.constellation.alignment import matrix_of
from madns_runtime.simulations.constellation.equipment import (
    AnySensorDevice,
    ClockDevice,
    GnssDevice,
    SensorDevice,
    StarTrackerDevice,
)
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.orbit.quaternions import (
    from_matrix,
    multiply,
    normalised,
)
from madns_runtime.simulations.constellation.sensor_channels import SensorChannel, channels_of
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene

TIME_DIGITS = 9
"""Of a sample's time, s: an age and the present lie apart by rounding alone."""
SAME_SAMPLE_S = 1e-3
"""Between the times of a receiver's position and of its velocity."""

Numbers = tuple[float, ...]
Correct = Callable[[Numbers, float], Numbers]
"""Takes a sample's numbers and its time, s, and returns a reading's; raises ValueError for what is none."""


class ChannelSource:
    """
    The readings of one sensor that is hardware.

    Args:
        name: The sensor's.
        settings: From the scenario.
        context: Whose devices it reads, and whose time.
        scene: Tells how the Earth stands.

    Raises:
        PluginError: The device or its channel is not there, or measures something else.
    """

    def __init__(
        self, name: str, settings: AnySensorDevice, *, context: AgentContext, scene: Scene
    ) -> None:
        channels = channels_of(name, settings)
        self._device: DeviceView = context.hardware[channels[0].device]
        factors = [_factor(self._device, channel, name) for channel in channels]
        self._names = [channel.name for channel in channels]
        self._correct = _correction(name, settings, factors, scene)
        self._now_s = context.now_s
        self._number = 0
        self.was_ok = False
        """Whether the device gave samples, of this channel or of others, at some tick."""
        self.skipped = 0
        """Samples of which a newer one was there before any tick looked."""
        self.absent = 0
        """Ticks without a reading since the device was stale or lost, or had not begun."""
        self.refused = 0
        """Samples that are none: of before the epoch, or without a direction."""
        self.unpaired = 0
        """Positions of a receiver that a newer one followed before any velocity had."""
        self._log = context.log
        self._waiting: tuple[int, int] | None = None
        """Numbers of a position that waits for its velocity, and of the velocity that was the newest then."""
        self._unpaired_before = 0
        """Counted when a reading was taken last."""

    def take(self) -> Reading | None:
        """Return the newest sample as a reading; None if it is no fresh one, or was returned before."""
        newest = [self._device[name] for name in self._names]
        first = newest[0]
        self.was_ok = self.was_ok or first.status == "ok"
        if first.status != "ok" or not first.number:
            self.absent += 1
            return None
        now_s = self._now_s()
        if first.number == self._number or not self._is_paired(newest, now_s):
            return None
        if self._number:
            unpaired = self.unpaired - self._unpaired_before
            self.skipped += max(0, first.number - self._number - 1 - unpaired)
        self._number, self._unpaired_before = first.number, self.unpaired
        t_s = round(now_s - first.age_s, TIME_DIGITS)
        raw = tuple(number for reading in newest for number in _numbers(reading.value))
        try:
            values = self._correct(raw, t_s)
        except ValueError:
            values = ()
        if not values or t_s < 0.0 or not all(map(math.isfinite, values)):
            self.refused += 1
            return None
        return Reading(t_s, values)

    def _is_paired(self, newest: Sequence[ChannelReading], now_s: float) -> bool:
        """Tell whether samples of several channels belong together; a position whose velocity never came is counted."""
        number, other = newest[0].number, newest[-1].number
        is_paired = _are_of_one_time(newest)
        if self._waiting is not None and number != self._waiting[0]:
            since, came = number - self._waiting[0], other - self._waiting[1]
            missing = min(since, since + is_paired - came)
            if missing > 0:
                self._tell(now_s)
                self.unpaired += missing
            self._waiting = None
        if is_paired:
            self._waiting = None
        elif self._waiting is None:
            self._waiting = (number, other)
        return is_paired

    def _tell(self, now_s: float) -> None:
        if not self.unpaired:
            self._log(
                "warning",
                f"{self._device.name}.{self._names[-1]} gave nothing to a sample of {self._names[0]} by {now_s:g} s, "
                "which so is no reading; others like it are counted as unpaired",
            )


def _are_of_one_time(newest: Sequence[ChannelReading]) -> bool:
    """Tell whether samples of several channels belong together; else the later one is still to come."""
    first = newest[0]
    return all(each.number and abs(each.age_s - first.age_s) < SAME_SAMPLE_S for each in newest)


def _numbers(value: float | Sequence[float]) -> Numbers:
    return (value,) if isinstance(value, float) else tuple(value)


def _factor(device: DeviceView, channel: SensorChannel, sensor: str) -> float:
    """
    Return the factor of a channel's values to those of readings.

    Raises:
        PluginError: It is no input of such values.
    """
    where = f"sensors.{sensor}.{channel.key}: {device.name}.{channel.name}"
    if channel.name not in device.inputs:
        known = ", ".join(device.inputs) or "none"
        raise PluginError(f"{where}: expected one of the device's inputs of numbers ({known})")
    form = device.form_of(channel.name)
    if form.size != channel.size:
        raise PluginError(f"{where}: expected values of {channel.size} numbers, got {form.size}")
    factor = factor_of(form.unit, channel.unit)
    if factor is None:
        raise PluginError(f"{where}: {unit_fault(form.unit, channel.unit)}")
    return factor


def _correction(
    sensor: str, settings: AnySensorDevice, factors: Sequence[float], scene: Scene
) -> Correct:
    """Return what makes a reading of a sample."""
    if isinstance(settings, GnssDevice):
        return _of_receiver(settings, factors, scene)
    if isinstance(settings, ClockDevice):
        scale, bias, factor = settings.scale, settings.bias, factors[0]
        return lambda raw, t_s: (factor * (scale * raw[0] - bias),)
    if isinstance(settings, StarTrackerDevice):
        mounting = from_matrix(np.array(matrix_of(settings.alignment)))
        return lambda raw, t_s: multiply(normalised(raw), mounting)
    correct = _of_vector(settings, factors[0])
    return _unit_length(correct) if sensor == "sun_sensor" else correct


def _of_vector(settings: SensorDevice, factor: float) -> Correct:
    (a, b, c), (d, e, f), (g, h, i) = matrix_of(settings.alignment)
    scale = settings.scale
    along = scale if isinstance(scale, tuple) else (scale, scale, scale)
    bias = settings.bias

    def correct(raw: Numbers, _t_s: float) -> Numbers:
        x, y, z = (k * value - none for k, value, none in zip(along, raw, bias, strict=True))
        return (
            factor * (a * x + b * y + c * z),
            factor * (d * x + e * y + f * z),
            factor * (g * x + h * y + i * z),
        )

    return correct


def _unit_length(correct: Correct) -> Correct:
    def direction(raw: Numbers, t_s: float) -> Numbers:
        vector = correct(raw, t_s)
        length = math.hypot(*vector)
        return tuple(number / length for number in vector) if length > 0.0 else ()

    return direction


def _of_receiver(settings: GnssDevice, factors: Sequence[float], scene: Scene) -> Correct:
    of_position, of_velocity = factors
    is_fixed = settings.frame == "ECEF"

    def correct(raw: Numbers, t_s: float) -> Numbers:
        r = tuple(of_position * number for number in raw[:3])
        v = tuple(of_velocity * number for number in raw[3:])
        return scene.from_fixed(t_s, r, v) if is_fixed else r + v

    return correct
