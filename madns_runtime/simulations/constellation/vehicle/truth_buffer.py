"""
An agent's buffer of its own future truth (thesis 2.5: quasi-noumenal). Pure, bounded.

Segments come in ahead of time; `lookup` serves any tick rate from them. Time only moves forward:
what lies before the last lookup is forgotten.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.orbit.hermite import (
    Coefficients,
    coefficients,
    evaluate,
)

SEGMENTS_MAX = 64
"""Segments held; a host that sends more is refused and counted."""
KNOTS_HELD_MAX = 200_000
"""Knots held over all segments: about 70 MB at worst."""
TIME_EPSILON_S = 1e-9
"""Rounding of tick and knot times, so that a tick on a joint falls into no gap."""


@dataclass(slots=True)
class _Piece:
    """A segment as plain numbers, valid up to end_s even if a newer revision cut it short."""

    revision: int
    t0_s: float
    knot_s: float
    end_s: float
    rows: list[list[float]]


class TruthBuffer:
    """Segments in order of time, without overlap."""

    def __init__(self) -> None:
        self.segments = 0
        """Segments taken."""
        self.refused = 0
        """Segments that did not fit the bounds."""
        self.superseded = 0
        """Segments, or parts, that a newer revision or a later time made worthless."""
        self.underruns = 0
        """Lookups for which no truth was there."""
        self.joint_gap_m_max = 0.0
        """Largest step in position where two segments of one revision meet: 0 if truth is continuous."""
        self._pieces: deque[_Piece] = deque()
        self._now_s = -math.inf
        self._knots = 0
        self._revision = 0
        self._revision_start_s = -math.inf
        self._low_s = self._high_s = math.inf
        self._cubics: Coefficients = ()
        self._knot_s = 1.0

    @property
    def end_s(self) -> float:
        """Simulated time of the last truth held; minus infinity if there is none."""
        return self._pieces[-1].end_s if self._pieces else -math.inf

    def add(self, segment: Segment) -> bool:
        """Take a segment; False if it was refused or is worthless by now."""
        start_s, end_s = segment.t0_s, segment.end_s
        if segment.revision < self._revision:
            end_s = min(end_s, self._revision_start_s)
        if end_s <= max(start_s, self._now_s):
            self.superseded += 1
            return False
        held = len(self._pieces) >= SEGMENTS_MAX
        if held or self._knots + len(segment.states) > KNOTS_HELD_MAX:
            self.refused += 1
            return False
        if segment.revision > self._revision:
            self._revision, self._revision_start_s = segment.revision, start_s
            self._cut_future(start_s)
        piece = _Piece(segment.revision, start_s, segment.knot_s, end_s, segment.states.tolist())
        self._insert(piece)
        self.segments += 1
        # The interval in use may have been replaced.
        self._low_s = self._high_s = math.inf
        return True

    def lookup(self, t_s: float) -> tuple[float, ...] | None:
        """
        Return position (m) and velocity (m/s) at *t_s*, six numbers.

        None if no truth is held for that time: an underrun, which is counted and never filled in by
        guesswork, since a made-up state would look like truth in every record after it.
        """
        if not self._low_s <= t_s < self._high_s and not self._seek(t_s):
            self.underruns += 1
            return None
        return evaluate(self._cubics, (t_s - self._low_s) / self._knot_s, self._knot_s)

    def _seek(self, t_s: float) -> bool:
        """Make the interval that holds *t_s* the one in use and forget what lies before."""
        self._now_s = max(self._now_s, t_s)
        pieces = self._pieces
        while pieces and pieces[0].end_s < t_s - TIME_EPSILON_S:
            self._knots -= len(pieces.popleft().rows)
        # At a joint the later piece counts: it may be the one after a maneuver.
        if len(pieces) > 1 and pieces[1].t0_s <= t_s:
            self._knots -= len(pieces.popleft().rows)
        if not pieces or t_s < pieces[0].t0_s - TIME_EPSILON_S:
            self._low_s = self._high_s = math.inf
            return False
        piece = pieces[0]
        index = min(max(int((t_s - piece.t0_s) / piece.knot_s), 0), len(piece.rows) - 2)
        self._knot_s = piece.knot_s
        self._low_s = piece.t0_s + index * piece.knot_s
        self._high_s = min(self._low_s + piece.knot_s, piece.end_s)
        self._cubics = coefficients(piece.rows[index], piece.rows[index + 1], piece.knot_s)
        return True

    def _cut_future(self, start_s: float) -> None:
        """Drop what the held pieces say of *start_s* and later."""
        while self._pieces and self._pieces[-1].end_s > start_s:
            last = self._pieces[-1]
            if last.t0_s < start_s:
                last.end_s = start_s
                break
            self._knots -= len(self._pieces.pop().rows)
            self.superseded += 1

    def _insert(self, piece: _Piece) -> None:
        """Put a piece where its time belongs; what two pieces of one revision share is the later one's."""
        pieces = self._pieces
        at = len(pieces)
        while at and pieces[at - 1].t0_s > piece.t0_s:
            at -= 1
        if at:
            self._join(pieces[at - 1], piece)
        if at < len(pieces):
            self._join(piece, pieces[at])
        pieces.insert(at, piece)
        self._knots += len(piece.rows)

    def _join(self, earlier: _Piece, later: _Piece) -> None:
        if abs(earlier.end_s - later.t0_s) <= TIME_EPSILON_S and earlier.revision == later.revision:
            gap_m = math.dist(earlier.rows[-1][:3], later.rows[0][:3])
            self.joint_gap_m_max = max(self.joint_gap_m_max, gap_m)
        earlier.end_s = min(earlier.end_s, max(later.t0_s, earlier.t0_s))
