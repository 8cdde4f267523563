"""Driver of `playback`; see `madns_runtime.hardware.kinds.playback`."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, Sample, SimulatedDevice, Value
from madns_runtime.hardware.kinds.playback import PlaybackParameters, streams_of
from madns_runtime.recording.reader import StreamReading, StreamState, read_stream

ROUNDING_S: Final = 1e-6
"""Of recorded times and ages together."""


class PlaybackDevice(SimulatedDevice):
    """Gives each recorded sample when it was handed on, with the time at which it was taken."""

    is_finite = True  # all samples that one tick found are of its time

    def open(self) -> str:
        """Begin the recording."""
        found_at = _finder(self.parameters)
        channels = streams_of(self.parameters.directory)
        self._has_inputs = any(channel.direction == "in" for channel, _ in channels)
        self._samples: Iterator[tuple[float, Sample]] = heapq.merge(
            *(
                self._samples_of(channel, files, found_at)
                for channel, files in channels
                if channel.direction == "in"
            ),
            key=lambda pair: pair[0],
        )
        self._next = next(self._samples, None)
        return str(self.parameters.directory)

    def close(self) -> None:
        """Close the recording's files: its samples refer to this device, and would keep them open."""
        self._samples, self._next = iter(()), None

    def _samples_of(
        self, channel: Channel, files: Sequence[Path], found_at: Callable[[float], float]
    ) -> Iterator[tuple[float, Sample]]:
        """Yield the samples of one input with their times, and count the lines of its files so far that were none."""
        for path in files:
            stream, counted = read_stream(path), 0
            for found in _samples(channel, stream, self.parameters, found_at):
                yield found
                # Now already, as a run may end before the recording does.
                counted += self._count_damaged(stream.passed, counted)
            self._count_damaged(stream.passed, counted)

    def _count_damaged(self, passed: StreamState, counted: int) -> int:
        """Count the lines that were none and are not *counted* yet, and return how many they are."""
        if found := passed.damaged + passed.truncated_lines - counted:
            self.count("damaged_lines", found)
        return found

    def sample_at(self, t_s: float) -> Sample | None:
        """Return the next sample that was handed on by *t_s*; of outputs alone, which have none on record, that they are there."""
        if not self._has_inputs:
            return Sample(values={}, taken_s=t_s)
        if self._next is None or self._next[0] > t_s:
            return None
        sample = self._next[1]
        self._next = next(self._samples, None)
        return sample

    def next_s(self) -> float | None:
        """Return when the next sample was handed on; None, for its rate, of a device of outputs alone."""
        if not self._has_inputs:
            return None
        return math.inf if self._next is None else self._next[0]

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """Put out nothing: what was given is on record."""


def _samples(
    channel: Channel,
    stream: StreamReading,
    parameters: PlaybackParameters,
    found_at: Callable[[float], float],
) -> Iterator[tuple[float, Sample]]:
    """
    Yield the samples of one input with the simulated time at which each is handed on, s.

    Raises:
        PluginError: A record is no sample's.
    """
    has_ticks = parameters.tick_hz is not None
    is_lockstep = has_ticks and parameters.ticks is None
    for record in stream.records():
        t_s, _, age_us, *values = record
        try:
            taken_s = t_s - parameters.start_s
            if is_lockstep:  # one of a tick itself must not lie behind that tick
                taken_s = found_at(taken_s)
            handed_s = taken_s + age_us * 1e-6
            value: Any = values if channel.shape else values[0]
            if channel.is_frame:
                value = bytes.fromhex(values[1])
        except (TypeError, ValueError):
            raise PluginError(
                f"{stream.path}: expected records [t_s, number, age_us, values ...], got {record!r:.80}"
            ) from None
        if None in values or (taken_s < 0 and not has_ticks):
            continue
        yield (
            found_at(handed_s),
            Sample(
                values={channel.name: value},
                taken_s=taken_s,
                handed_s=handed_s if has_ticks else None,
            ),
        )


def _meant(tick_hz: float, t_s: float) -> float:
    """Return a time, s, or that of the tick beside which it lies by rounding alone."""
    tick_s = round(t_s * tick_hz) / tick_hz
    return tick_s if abs(t_s - tick_s) <= ROUNDING_S else t_s


def _finder(parameters: PlaybackParameters) -> Callable[[float], float]:
    """Return what tells when in simulated time a sample is there that was handed on at a time, s."""
    tick_hz, start_s = parameters.tick_hz, parameters.start_s
    if tick_hz is None:
        return float
    if parameters.ticks is None:
        return partial(_meant, tick_hz)
    nominal_s: list[float] = []
    woke_s: list[float] = []
    for tick, lateness_us, *_ in read_stream(parameters.ticks).records():
        t_s = tick / tick_hz - start_s
        nominal_s.append(t_s)
        woke_s.append(t_s + parameters.phase_s + lateness_us * 1e-6)

    def found_at(handed_s: float) -> float:
        place = bisect_left(woke_s, handed_s - ROUNDING_S)
        return nominal_s[place] if place < len(nominal_s) else math.inf

    return found_at
