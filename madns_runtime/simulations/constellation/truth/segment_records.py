"""
Records of truth as the host sent it: one record a segment, and a vehicle's truth read back from them. Pure.

A record holds from its first knot on, also against what earlier records say of that time: so truth that a
maneuver replaced is gone, whatever its revision. Between knots the agents' own interpolation is used.

Numbers are packed as short text without losing a bit. Along each column the bit patterns are whole numbers that
grow smoothly, so their differences of some order are small: what is left are the leading zeros, which deflate
removes. Whole numbers wrap around, so that every pattern comes back exactly, also across a change of sign or of
exponent.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.orbit.interpolation import (
    evaluate_turn,
    interpolate,
    turn_between,
)
from madns_runtime.simulations.constellation.orbit.quaternions import IDENTITY
from madns_runtime.simulations.constellation.parameters import KNOTS_MAX
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Piece

Array = NDArray[np.float64]

STATE_COLUMNS, ATTITUDE_COLUMNS = 6, 7
JOINT_S = 1e-6
"""Ends of one segment and beginnings of the next that are so near leave no gap: rounding of knots' times."""

ORDER_MAX = 9
"""Highest order of differences: beyond, rounding grows faster than what is smooth gets less."""
LEVEL = 1
"""Of deflate: higher ones save 2 % and take half as long again."""
VALUES_MAX = 2_000_000
"""Numbers in one text, 16 MB: more is damage, not a record."""
_LAYOUT = "<f8"


def record_of(segment: Segment, agent: str, sent_s: float) -> tuple[Any, ...]:
    """Return the values of TRUTH's fields for a segment."""
    attitude = None if segment.attitude is None else pack_numbers(segment.attitude)
    return (
        sent_s,
        agent,
        segment.revision,
        segment.t0_s,
        segment.knot_s,
        len(segment.states),
        pack_numbers(segment.states),
        attitude,
    )


class TruthHistory:
    """Truth of one vehicle as it was sent, without what was superseded."""

    def __init__(self) -> None:
        self.revision = 0
        """The newest on record."""
        self._stretches: list[Piece] = []
        # As a vehicle's own buffer of truth begins.
        self._quaternion = np.array(IDENTITY)

    @property
    def is_rigid(self) -> bool:
        """Whether attitude is on record."""
        return any(stretch.attitude is not None for stretch in self._stretches)

    @property
    def end_s(self) -> float:
        """Simulated time of the last knot on record; 0 without any."""
        return self._stretches[-1].end_s if self._stretches else 0.0

    def add(self, record: Sequence[Any]) -> None:
        """
        Take a vehicle's next record, in the order of recording.

        Raises:
            ValueError: It is no record of truth; says why.
        """
        stretch, revision = _read(record)
        if revision < self.revision:
            raise ValueError(f"revision {revision} after revision {self.revision}")
        self.revision = revision
        kept = self._stretches
        while kept and kept[-1].t0_s >= stretch.t0_s:
            kept.pop()
        if kept and kept[-1].end_s > stretch.t0_s:
            kept[-1] = replace(kept[-1], end_s=stretch.t0_s)
        kept.append(stretch)

    def tabulate(self, times_s: Array) -> Array:
        """
        Return truth at ascending times, shape (M, 6), or (M, 13) for a rigid body; NaN where none is on record.

        Later calls ask for later times.

        Columns: position (m), velocity (m/s), then quaternion (scalar last, inertial to body, its sign
        continuous) and body rates (rad/s).
        """
        width = STATE_COLUMNS + (ATTITUDE_COLUMNS if self.is_rigid else 0)
        table = np.full((len(times_s), width), np.nan)
        starts_s = np.array([stretch.t0_s for stretch in self._stretches])
        # At a joint the later one holds: it may be the one after a maneuver.
        which = np.searchsorted(starts_s, times_s, side="right") - 1
        for number in np.unique(which[which >= 0]).tolist():
            stretch = self._stretches[number]
            rows = np.flatnonzero((which == number) & (times_s <= stretch.end_s + JOINT_S))
            if not len(rows):
                continue
            at_s, t0_s, knot_s = times_s[rows], stretch.t0_s, stretch.knot_s
            # A joint's rounding is not a time beyond the knots.
            at_s = np.minimum(at_s, t0_s + (len(stretch.states) - 1) * knot_s)
            table[rows, :STATE_COLUMNS] = interpolate(
                stretch.states, at_s, t0_s=t0_s, knot_s=knot_s
            )
            if stretch.attitude is not None:
                table[rows, STATE_COLUMNS:] = _turned(stretch, at_s)
        if self.is_rigid:
            self._continue_signs(table[:, STATE_COLUMNS : STATE_COLUMNS + 4])
        return table

    def _continue_signs(self, quaternions: Array) -> None:
        """Let each row's sign go on from the last one's, in place: both signs are the same attitude."""
        known = np.flatnonzero(np.isfinite(quaternions[:, 0]))
        if not len(known):
            return
        rows = quaternions[known]
        before = np.concatenate((self._quaternion[None], rows[:-1]))
        cosines = np.einsum("ij,ij->i", rows, before)
        rows *= np.cumprod(np.where(cosines < 0.0, -1.0, 1.0))[:, None]
        quaternions[known] = rows
        self._quaternion = rows[-1].copy()


def _read(record: Sequence[Any]) -> tuple[Piece, int]:
    _, _, revision, t0_s, knot_s, knots, states, attitude = record
    if type(revision) is not int or type(knots) is not int or not 2 <= knots <= KNOTS_MAX:
        raise ValueError(
            f"expected a revision and 2 to {KNOTS_MAX} knots, got {revision!r}, {knots!r}"
        )
    t0_s, knot_s = float(t0_s), float(knot_s)
    if not (np.isfinite(t0_s) and 0.0 < knot_s < np.inf):
        raise ValueError(f"expected the time and the distance of knots, got {t0_s!r}, {knot_s!r}")
    stretch = Piece(
        t0_s=t0_s,
        knot_s=knot_s,
        end_s=t0_s + (knots - 1) * knot_s,
        states=unpack_numbers(states, knots, STATE_COLUMNS),
        attitude=None if attitude is None else unpack_numbers(attitude, knots, ATTITUDE_COLUMNS),
    )
    return stretch, revision


def _turned(stretch: Piece, times_s: Array) -> Array:
    """Return attitude and rates at times within a stretch, shape (M, 7), by the agents' own function."""
    assert stretch.attitude is not None
    rows, knot_s = stretch.attitude.tolist(), stretch.knot_s
    found, held, turn = [], -1, None
    for t_s in times_s.tolist():
        index = min(max(int((t_s - stretch.t0_s) / knot_s), 0), len(rows) - 2)
        if index != held or turn is None:
            held, turn = index, turn_between(rows[index], rows[index + 1], knot_s)
        found.append(evaluate_turn(turn, (t_s - (stretch.t0_s + index * knot_s)) / knot_s, knot_s))
    return np.array(found)


def pack_numbers(numbers: Array) -> str:
    """
    Return a table of numbers as base64 text, for `unpack_numbers`.

    Args:
        numbers: Shape (K, C), float64, rows in order of time.
    """
    bits = np.ascontiguousarray(numbers, dtype=_LAYOUT).view("<i8")
    orders = np.empty((min(ORDER_MAX, len(bits) - 1) + 1, *bits.shape), bits.dtype)
    orders[0] = bits
    for before, after in pairwise(range(len(orders))):
        orders[after] = orders[before]
        orders[after, after:] -= orders[before, before:-1]
    sizes = _sizes(orders)
    order = 0
    while order + 1 < len(sizes) and sizes[order + 1] < sizes[order]:
        order += 1
    bits = orders[order]
    # Sign last, so that small negative numbers have leading zeros too; then byte by byte, not number by number.
    folded = (bits << 1) ^ (bits >> 63)
    planes = np.ascontiguousarray(folded.T).view(np.uint8).reshape(-1, 8).T
    return base64.b64encode(bytes((order,)) + zlib.compress(planes.tobytes(), LEVEL)).decode()


def unpack_numbers(text: str, rows: int, columns: int) -> Array:
    """
    Return the table that a text holds, shape (rows, columns), every bit as it was.

    Raises:
        ValueError: The text holds no such table.
    """
    expected = rows * columns * 8
    if not 0 < expected <= VALUES_MAX * 8:
        raise ValueError(f"expected 1 to {VALUES_MAX} numbers, got {rows} x {columns}")
    try:
        packed = base64.b64decode(text, validate=True)
        unpacking = zlib.decompressobj()
        plain = unpacking.decompress(packed[1:], expected)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise ValueError(f"no packed numbers: {error}") from error
    if len(plain) != expected or packed[0] > ORDER_MAX or not unpacking.eof:
        raise ValueError(f"expected {expected} bytes of packed numbers, got {len(plain)} or more")
    planes = np.frombuffer(plain, np.uint8).reshape(8, -1)
    folded = np.ascontiguousarray(planes.T).view("<u8").reshape(columns, rows).T
    bits = ((folded >> 1) ^ -(folded & 1)).astype("<i8")
    for step in reversed(range(packed[0])):
        bits[step:] = np.cumsum(bits[step:], axis=0)
    return np.ascontiguousarray(bits).view(_LAYOUT).astype(np.float64, copy=False)


def _sizes(orders: NDArray[np.int64]) -> list[float]:
    """Return a measure of what the numbers of each order need: the sum of their lengths in bits, or nearly so."""
    lengths = np.log2(np.abs(orders.astype(np.float64)) + 1.0)
    sizes: list[float] = lengths.reshape(len(orders), -1).sum(axis=1).tolist()
    return sizes
