"""
Faults inserted around a device: what it measures is frozen, biased, noisy, dropped or late, or it is unplugged.

Pure: the same samples, times and seed give the same values. Whatever the device itself does, it knows nothing of it.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.fault_actions import check_fault
from madns_runtime.written_times import later_s

HELD_MAX: Final = 10_000
"""Delayed samples that may wait; the oldest is given up beyond, and counted."""


class InsertedFaults:
    """
    The faults that are in force on one device.

    Args:
        seed: Of noise and drops.
    """

    def __init__(self, seed: int | Sequence[int]) -> None:
        self._random = np.random.default_rng(seed)
        self._values: dict[str, float] = {}
        self._frozen: dict[str, Value] = {}
        self._newest: dict[str, Value] = {}
        self._held: deque[Sample] = deque()
        self._left_to_device: frozenset[str] = frozenset()
        """Actions that the device carries out itself."""
        self.dropped = 0
        """Samples that *drop* lost, and delayed ones that found no room."""

    @property
    def is_disconnected(self) -> bool:
        """Whether the device is to be closed and stay so."""
        return "disconnect" in self._values

    @property
    def in_force(self) -> Mapping[str, float]:
        """The actions in force with their values; not a number where they take none."""
        return self._values

    def show_to(self, device: Device) -> None:
        """Let a device that is about to be opened see the faults in force, and leave to it what it carries out."""
        device.inserted_faults = MappingProxyType(self._values)
        self._left_to_device = device.carries_out

    def insert(self, action: str, value: float | None = None) -> None:
        """
        Put a fault in force until `clear`; one of the same action is replaced.

        Raises:
            ConfigurationError: As `check_fault`.
        """
        check_fault(action, value)
        if action == "clear":
            self._values.clear()
            self._frozen.clear()
            return
        self._values[action] = math.nan if value is None else value
        if action == "freeze":
            self._frozen = dict(self._newest)

    def apply(self, sample: Sample) -> Sample | None:
        """Return what becomes of a sample: None if it is dropped, or late and asked for by `due`."""
        self._newest.update(sample.values)
        if not self._values:
            return sample
        if self._alters("drop") and self._random.random() < self._values["drop"]:
            self.dropped += 1
            return None
        sample = dataclasses.replace(
            sample, values={name: self._alter(name, value) for name, value in sample.values.items()}
        )
        if not self._alters("delay"):
            return sample
        self._held.append(sample)
        if len(self._held) > HELD_MAX:
            self._held.popleft()
            self.dropped += 1
        return None

    def due(self, now_s: float) -> list[Sample]:
        """Return the delayed samples whose time has come by *now_s*; of a device that is disconnected none."""
        found = []
        while self.next_due_s() <= now_s:
            found.append(self._held.popleft())
        return found

    def forget_held(self) -> int:
        """Forget the delayed samples that wait, and return how many they were."""
        count = len(self._held)
        self._held.clear()
        return count

    def next_due_s(self) -> float:
        """Return when the next delayed sample is due; infinity if none waits, or the device is disconnected."""
        if not self._held or self.is_disconnected:
            return math.inf
        return later_s(self._held[0].taken_s, self._values.get("delay", 0.0))

    def _alters(self, action: str) -> bool:
        """Tell whether samples are altered by an action: it is in force, and nobody else carries it out."""
        return action in self._values and action not in self._left_to_device

    def _alter(self, name: str, value: Value) -> Any:
        if self._alters("freeze"):
            value = self._frozen.setdefault(name, value)
        bias = self._values["bias"] if self._alters("bias") else None
        sigma = self._values["noise"] if self._alters("noise") else None
        if isinstance(value, bytes | str) or (bias is None and sigma is None):
            return value
        altered = np.asarray(value, dtype=np.float64) + (bias or 0.0)
        if sigma:
            altered = altered + self._random.normal(0.0, sigma, altered.shape)
        return altered.tolist()
