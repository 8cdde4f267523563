"""Driver of `synthetic`; see `madns_runtime.hardware.kinds.synthetic`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from madns_runtime.hardware.contract import Sample, SimulatedDevice
from madns_runtime.hardware.kinds.synthetic import Waveform


def _triangle(cycles: float) -> float:
    return 4.0 * abs(cycles - math.floor(cycles + 0.5)) - 1.0


SHAPES: Final[dict[str, Callable[[float], float]]] = {
    "constant": lambda cycles: 0.0,
    "sine": lambda cycles: math.sin(2.0 * math.pi * cycles),
    "square": lambda cycles: 1.0 if cycles % 1.0 < 0.5 else -1.0,
    "triangle": _triangle,
    "sawtooth": lambda cycles: 2.0 * (cycles % 1.0) - 1.0,
}
"""Shapes of period 1 between -1 and 1, by the number of periods that have passed."""


class SyntheticDevice(SimulatedDevice):
    """Computes its samples; the noise of one depends on the seed, on whose device it is and on how many were before."""

    def open(self) -> str:
        """Begin the noise anew."""
        # Without its place, the devices that a scenario gives its agents would all err alike.
        self._random = np.random.default_rng([self.parameters.seed, *self.place.encode()])
        return "synthetic"

    def sample_at(self, t_s: float) -> Sample | None:
        """Return the waveforms at *t_s*."""
        values = {}
        for channel in self.parameters.channels:
            numbers = [self._value(element, t_s) for element in channel.elements]
            values[channel.name] = numbers if len(numbers) > 1 else numbers[0]
        return Sample(values=values, taken_s=t_s)

    def _value(self, element: Waveform, t_s: float) -> float:
        if element.shape == "ramp":
            value = element.amplitude * t_s
        else:
            cycles = element.frequency_hz * t_s + element.phase
            value = element.amplitude * SHAPES[element.shape](cycles)
        if element.noise:
            value += element.noise * self._random.standard_normal()
        return element.offset + value
