"""
Errors of sensors: white noise, a constant bias, a bias that walks, and samples that never come.

A sample's error depends on its number alone: not on the samples before it, not on other sensors, not on
ticks that were skipped or on how often the agent was started. Random numbers come in blocks, each from
a counter-based generator that is set to the block's number.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.equipment import Gnss, SensorNoise
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import Row

BLOCK = 256
"""Samples whose errors are drawn at a time."""


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


def error_model(settings: SensorNoise, channels: int, *, period_s: float) -> ErrorModel:
    """
    Return the errors that a scenario gives to a sensor.

    Args:
        settings: The scenario's.
        channels: Errors that a measurement needs.
        period_s: Between samples, s.
    """
    # A receiver's velocity has a noise of its own, and no bias.
    of_velocity = (settings.velocity_noise_m_s,) * 3 if isinstance(settings, Gnss) else ()
    others, unbiased = channels - len(of_velocity), (0.0,) * len(of_velocity)
    return ErrorModel(
        white=(settings.noise,) * others + of_velocity,
        bias=(settings.bias,) * others + unbiased,
        walk=(settings.bias_walk,) * others + unbiased,
        dropout=settings.dropout,
        period_s=period_s,
    )


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
