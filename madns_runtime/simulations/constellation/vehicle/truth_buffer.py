"""
An agent's buffer of its own future truth (thesis 2.5: quasi-noumenal). Pure, bounded.

Segments come in ahead of time; `lookup` serves any tick rate from them. Time only moves forward:
what lies before the last lookup is forgotten.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.orbit.interpolation import (
    AttitudeCurve,
    Coefficients,
    coefficients,
    evaluate,
    evaluate_turn,
    turn_between,
)
from madns_runtime.simulations.constellation.orbit.quaternions import IDENTITY, Vector
from madns_runtime.simulations.constellation.thrust import Thrust

SEGMENTS_MAX = 512
"""
Segments held; a host that sends more is refused and counted. A burn has one of its own, and three lie between two burns: the
64 commands of a vehicle that may wait at once make up to 260.
"""
KNOTS_HELD_MAX = 200_000
"""Knots held over all segments: about 70 MB at worst, 150 MB with attitude."""
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
    turns: list[list[float]] | None
    thrust: Thrust | None
    ballistic_m2_kg: float | None

    def cut_at(self, t_s: float) -> int:
        """End it at *t_s*, and return how many knots behind that nobody will ask for are let go of."""
        if t_s >= self.end_s:
            return 0
        self.end_s = t_s
        kept = max(2, int((self.end_s - self.t0_s) / self.knot_s) + 3)
        released = max(0, len(self.rows) - kept)
        del self.rows[kept:]
        if self.turns is not None:
            del self.turns[kept:]
        return released

    def velocity_at_end(self) -> Sequence[float]:
        """Return the velocity where it ends, m/s: that of its last knot, or between two where it was cut short."""
        part = (self.end_s - self.t0_s) / self.knot_s
        if part > len(self.rows) - 1 - TIME_EPSILON_S:
            return self.rows[-1][3:6]
        index = int(part)
        cubics = coefficients(self.rows[index], self.rows[index + 1], self.knot_s)
        return evaluate(cubics, part - index, self.knot_s)[3:6]


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
        self._starts: list[tuple[int, float]] = []
        self._low_s = self._high_s = math.inf
        self._cubics: Coefficients = ()
        self._knot_s = 1.0
        self._turn: AttitudeCurve | None = None
        self._quaternion = IDENTITY
        self._thrust_m_s = [0.0, 0.0, 0.0]
        self._impulses_m_s = [0.0, 0.0, 0.0]
        self._given_until_s: float | None = None

    @property
    def end_s(self) -> float:
        """Simulated time of the last truth held; minus infinity if there is none."""
        return self._pieces[-1].end_s if self._pieces else -math.inf

    def add(self, segment: Segment) -> bool:
        """Take a segment; False if it was refused or is worthless by now."""
        start_s = segment.t0_s
        # From where a newer revision begins, this one is replaced.
        newer_s = (at_s for number, at_s in self._starts if number > segment.revision)
        end_s = min(segment.end_s, min(newer_s, default=math.inf))
        if end_s <= max(start_s, self._now_s):
            self.superseded += 1
            return False
        # What it replaces makes room for it, and holds no more even if there is none.
        self._begin(segment.revision, start_s)
        self._low_s = self._high_s = math.inf  # the interval in use may be replaced
        held = len(self._pieces) >= SEGMENTS_MAX
        if held or self._knots + len(segment.states) > KNOTS_HELD_MAX:
            self.refused += 1
            return False
        piece = _Piece(
            segment.revision,
            start_s,
            segment.knot_s,
            end_s,
            segment.states.tolist(),
            None if segment.attitude is None else segment.attitude.tolist(),
            segment.thrust,
            segment.ballistic_m2_kg,
        )
        self._insert(piece)
        self.segments += 1
        return True

    def lookup(self, t_s: float) -> tuple[float, ...] | None:
        """
        Return position (m) and velocity (m/s) at *t_s*, six numbers.

        Of a rigid body thirteen: quaternion (scalar last, inertial to body, its sign continuous)
        and body rates (rad/s) after them.

        None if no truth is held for that time: an underrun, which is counted and never filled in by
        guesswork, since a made-up state would look like truth in every record after it.
        """
        if not self._low_s <= t_s < self._high_s and not self._seek(t_s):
            self.underruns += 1
            return None
        part = (t_s - self._low_s) / self._knot_s
        if self._turn is None:
            return evaluate(self._cubics, part, self._knot_s)
        turned = evaluate_turn(self._turn, part, self._knot_s)
        return evaluate(self._cubics, part, self._knot_s) + turned

    def given_m_s(self, t_s: float) -> tuple[Vector, Vector]:
        """
        Return the changes of velocity that thrust, and that impulses, have given until *t_s*, m/s, inertial.

        They count from the first call on. Call it right after a `lookup` of the same time has found truth:
        an impulse is the step in velocity where two segments meet.
        """
        if self._given_until_s is None:
            self._given_until_s = t_s
        self._give(self._pieces[0].thrust, t_s)
        (x, y, z), (a, b, c) = self._thrust_m_s, self._impulses_m_s
        return (x, y, z), (a, b, c)

    @property
    def ballistic_m2_kg(self) -> float | None:
        """Ballistic coefficient at the last lookup, m^2/kg; None where nobody said, or there is no drag."""
        return self._pieces[0].ballistic_m2_kg if self._pieces else None

    def _seek(self, t_s: float) -> bool:
        """Make the interval that holds *t_s* the one in use and forget what lies before."""
        self._now_s = max(self._now_s, t_s)
        pieces = self._pieces
        while pieces and pieces[0].end_s < t_s - TIME_EPSILON_S:
            self._leave_first()
        # At a joint the later piece counts: it may be the one after a maneuver, and another joint may be as near.
        while len(pieces) > 1 and pieces[1].t0_s <= t_s:
            self._leave_first()
        if not pieces or t_s < pieces[0].t0_s - TIME_EPSILON_S:
            self._low_s = self._high_s = math.inf
            return False
        piece = pieces[0]
        index = min(max(int((t_s - piece.t0_s) / piece.knot_s), 0), len(piece.rows) - 2)
        self._knot_s = piece.knot_s
        self._low_s = piece.t0_s + index * piece.knot_s
        self._high_s = min(self._low_s + piece.knot_s, piece.end_s)
        self._cubics = coefficients(piece.rows[index], piece.rows[index + 1], piece.knot_s)
        self._turn = None
        if piece.turns is not None:
            self._seek_turn(piece.turns[index], piece.turns[index + 1])
        return True

    def _leave_first(self) -> None:
        """Forget the first piece; what it gave is kept, if anybody asks for that."""
        piece = self._pieces.popleft()
        self._knots -= len(piece.rows)
        if self._given_until_s is None:
            return
        self._give(piece.thrust, piece.end_s)
        if not self._pieces:
            return
        after = self._pieces[0]
        self._given_until_s = after.t0_s
        if after.t0_s - piece.end_s <= TIME_EPSILON_S:
            before = piece.velocity_at_end()
            for axis in range(3):
                self._impulses_m_s[axis] += after.rows[0][3 + axis] - before[axis]

    def _give(self, thrust: Thrust | None, until_s: float) -> None:
        """Add what a thrust gives from where the account ends; a thrust that was cut short is taken back."""
        if thrust is not None and self._given_until_s is not None:
            gained_s, _ = thrust.gains(self._given_until_s, until_s)
            for axis in range(3):
                self._thrust_m_s[axis] += thrust.acceleration_m_s2[axis] * gained_s
        self._given_until_s = until_s

    def _seek_turn(self, first: list[float], second: list[float]) -> None:
        """Make the interval's attitude the one in use; it goes on from the last with the same sign."""
        if sum(a * b for a, b in zip(first, self._quaternion, strict=False)) < 0.0:
            first = [-number for number in first[:4]] + first[4:]
        self._turn = turn_between(first, second, self._knot_s)
        x, y, z, w = second[:4]
        is_same = sum(a * b for a, b in zip(first, second[:4], strict=False)) >= 0.0
        self._quaternion = (x, y, z, w) if is_same else (-x, -y, -z, -w)

    def _begin(self, revision: int, start_s: float) -> None:
        """
        Let *revision* replace what older ones say of *start_s* and later, if it is not known yet.

        Its segments may come in any order, and later than those of a revision after it.
        """
        starts = self._starts
        if not revision or any(n >= revision and at_s <= start_s for n, at_s in starts):
            return
        kept = [(n, at_s) for n, at_s in starts if n > revision or at_s < start_s]
        kept.append((revision, start_s))
        kept.sort()
        # Of the past, the newest is enough: what older ones say of later times is worthless.
        while len(kept) > 1 and kept[1][1] <= self._now_s:
            kept.pop(0)
        self._starts = kept
        self._cut_older(revision, start_s)

    def _cut_older(self, revision: int, start_s: float) -> None:
        """Drop what pieces of older revisions say of *start_s* and later."""
        pieces: deque[_Piece] = deque()
        for piece in self._pieces:
            if piece.revision < revision and piece.t0_s >= start_s:
                self._knots -= len(piece.rows)
                self.superseded += 1
                continue
            if piece.revision < revision:
                self._knots -= piece.cut_at(start_s)
            pieces.append(piece)
        self._pieces = pieces

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
