"""
A vehicle's truth ahead of its tick, at any time from now on: what a `TruthBuffer`, which forgets what it has passed, cannot give.

Pure, bounded. Each segment is kept until it is past or a newer revision has replaced it; of a time the newest revision that
has begun by then counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.vehicle.truth_buffer import (
    KNOTS_HELD_MAX,
    SEGMENTS_MAX,
    TIME_EPSILON_S,
    TruthBuffer,
)


@dataclass(slots=True)
class _BufferedSegment:
    """A segment in a buffer of its own."""

    revision: int
    t0_s: float
    end_s: float
    """Until when it holds: its last knot, or sooner if a newer revision begins before."""
    knots: int
    truth: TruthBuffer


class FutureTruth:
    """Segments of one vehicle, from now on."""

    def __init__(self) -> None:
        self.refused = 0
        """Segments that did not fit the bounds."""
        self._segments: list[_BufferedSegment] = []
        self._starts: dict[int, float] = {}
        """First time of each revision, s."""
        self._in_use: _BufferedSegment | None = None
        self._until_s = -math.inf
        self._attitude: tuple[float, ...] = ()

    @property
    def end_s(self) -> float:
        """Simulated time of the last truth held; minus infinity if there is none."""
        return max((each.end_s for each in self._segments), default=-math.inf)

    def add(self, segment: Segment) -> bool:
        """Take a segment; False if it was refused, or a newer revision has replaced all of it."""
        revision, knots = segment.revision, len(segment.states)
        newer_s = min((at_s for n, at_s in self._starts.items() if n > revision), default=math.inf)
        if newer_s <= segment.t0_s:
            return False
        start_s = min(self._starts.get(revision, math.inf), segment.t0_s)
        # Of a vehicle that is commanded at every tick, each future lies as far ahead as the one that replaces it.
        kept = [each for each in self._segments if each.revision >= revision or each.t0_s < start_s]
        held = sum(each.knots for each in kept)
        if len(kept) >= SEGMENTS_MAX or held + knots > KNOTS_HELD_MAX:
            self.refused += 1
            return False
        for each in kept:
            if each.revision < revision:
                each.end_s = min(each.end_s, start_s)
        truth = TruthBuffer()
        truth.add(segment)
        end_s = min(segment.end_s, newer_s)
        self._segments = [*kept, _BufferedSegment(revision, segment.t0_s, end_s, knots, truth)]
        self._starts[revision] = start_s
        self._in_use = None
        return True

    def forget(self, now_s: float) -> None:
        """Let go of what is past."""
        self._segments = [each for each in self._segments if each.end_s >= now_s]
        begun = [number for number, at_s in self._starts.items() if at_s <= now_s]
        newest = max(begun, default=0)
        self._starts = {n: at_s for n, at_s in self._starts.items() if n >= newest}

    def lookup(self, t_s: float) -> tuple[float, ...] | None:
        """Return truth as `TruthBuffer.lookup` does; None if there is none, which is not counted."""
        found = self._in_use
        if found is None or not found.t0_s <= t_s < self._until_s:
            found = self._in_use = self._find(t_s)
        state = None if found is None else found.truth.lookup(t_s)
        if state is None or len(state) == 6:
            return state
        # One sign for an attitude from segment to segment, as for who looks up tick by tick.
        attitude = state[6:10]
        if sum(a * b for a, b in zip(attitude, self._attitude, strict=False)) < 0.0:
            attitude = tuple(-number for number in attitude)
        self._attitude = attitude
        return state[:6] + attitude + state[10:]

    def _find(self, t_s: float) -> _BufferedSegment | None:
        """Return the segment that counts at a time, and note until when it does."""
        late_s = t_s + TIME_EPSILON_S
        begun = [number for number, at_s in self._starts.items() if at_s <= late_s]
        revision = max(begun, default=None)
        own = [each for each in self._segments if each.revision == revision]
        found: _BufferedSegment | None = None
        for each in own:
            is_there = each.t0_s <= late_s and t_s <= each.end_s + TIME_EPSILON_S
            if is_there and (found is None or each.t0_s >= found.t0_s):
                found = each
        if found is not None:
            later = [each.t0_s for each in own if each.t0_s > late_s]
            newer = [s for n, s in self._starts.items() if n > found.revision and s > late_s]
            self._until_s = min([found.end_s, *later, *newer])
        return found
