"""Driver of `playback`; see `madns_runtime.hardware.kinds.playback`."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from madns_runtime.hardware.contract import Channel, Sample, SimulatedDevice
from madns_runtime.hardware.kinds.playback import _streams
from madns_runtime.recording.reader import read_stream


class PlaybackDevice(SimulatedDevice):
    """Gives each recorded sample when it was handed on, with the time at which it was taken."""

    def open(self) -> str:
        """Begin the recording."""
        streams = _streams(self.parameters.directory)
        self._samples = heapq.merge(
            *(_samples(channel, path, self.parameters.start_s) for channel, path in streams),
            key=lambda pair: pair[0],
        )
        self._next = next(self._samples, None)
        return str(self.parameters.directory)

    def sample_at(self, t_s: float) -> Sample | None:
        """Return the next sample that was handed on by *t_s*."""
        if self._next is None or self._next[0] > t_s:
            return None
        sample = self._next[1]
        self._next = next(self._samples, None)
        return sample

    def next_s(self) -> float:
        """Return when the next sample was handed on."""
        return math.inf if self._next is None else self._next[0]


def _samples(channel: Channel, path: Path, start_s: float) -> Iterator[tuple[float, Sample]]:
    """Yield the samples of one input with the time at which each was handed on, s."""
    for t_s, _, age_us, *values in read_stream(path).records():
        taken_s = t_s - start_s
        if taken_s < 0 or None in values:
            continue
        value: Any = values if channel.shape else values[0]
        if channel.is_frame:
            value = bytes.fromhex(values[1])
        yield taken_s + age_us * 1e-6, Sample(values={channel.name: value}, taken_s=taken_s)
