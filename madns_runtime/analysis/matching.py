"""
Matching of the records of two streams: by tick, or by time. Pure numpy.

Both streams are read side by side, so that neither is ever held whole: what is held is a batch of each
and the rows between the ends of the two. Keys that go back by more than was seen before they were settled are told
(`KeyWentBackError`): with the order of both streams, learnt from all of their keys, no record is settled too early.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.record_order import RecordOrder, by_whom, gone_back
from madns_runtime.analysis.values import Floats
from madns_runtime.recording.columns import joined_column

Indices = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]
FINEST = 1e-3
"""Share of the tolerance that keys have to be told apart by, however far some of them are away."""
ROWS_HELD_MAX = 1 << 19
"""Records of both streams that wait for others; beyond, what lies behind the newest of both waits no longer."""
Orders = tuple[RecordOrder, RecordOrder]


class KeyWentBackError(Exception):
    """A record came behind others of keys so far beyond its own that its partner may be settled already."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Some records of one stream, in the order of recording."""

    keys: Floats
    """Tick, or time in s; shape (N,)."""
    who: NDArray[Any]
    """Subject of each record, as text; records match only where it is the same. Shape (N,)."""
    columns: Columns
    ranks: Floats | None = None
    """Order of records of one key and whom, as their own numbers tell; None for the order of recording. Shape (N,)."""

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self.keys)

    def take(self, index: NDArray[Any]) -> Rows:
        """Return the rows at *index*, numbers or a mask."""
        columns = {name: values[index] for name, values in self.columns.items()}
        ranks = None if self.ranks is None else self.ranks[index]
        return Rows(keys=self.keys[index], who=self.who[index], columns=columns, ranks=ranks)


@dataclass(frozen=True, slots=True, kw_only=True)
class Matched:
    """Settled part of both streams: pairs, row for row, and records that only one of them has."""

    a: Rows
    b: Rows
    only_a: Rows
    only_b: Rows


def match(
    a: Iterable[Rows],
    b: Iterable[Rows],
    *,
    tolerance: float,
    orders: Orders | None = None,
    must_wait: bool = False,
) -> Iterator[Matched]:
    """
    Match two streams whose keys grow, or go back as *orders* tells.

    Records are pairs if each is the other's nearest and they are no further apart than *tolerance*.
    Several records of one key and whom are matched in the order of their ranks, or else in their own. Without *orders* a record waits
    for others as long as keys of its stream went back so far; one that comes later still is not found by its partner, and
    both count as alone.

    Args:
        a: Batches of one stream, at least one.
        b: Batches of the other, at least one.
        tolerance: Largest distance of a pair's keys.
        orders: Orders of both, as all of their keys tell; None where they are not known.
        must_wait: Whether a record that comes too late is an error.

    Raises:
        KeyWentBackError: One came too late, and it must not.
    """
    of_a, of_b = orders or (None, None)
    first, second = sides = (_Side(a, of_a), _Side(b, of_b))
    settled_to = -np.inf
    while not (first.has_ended and second.has_ended):
        going_on = [side for side in sides if not side.has_ended]
        # Where keys go back it is not the newest one that tells which of them is behind.
        behind = min(going_on, key=lambda s: s.newest if orders is None else len(s.held))
        behind.read()
        if must_wait and orders is None and behind.lowest < settled_to:
            raise KeyWentBackError
        frontiers = _Frontiers(sides)
        settled = _settle(first, second, frontiers, tolerance)
        if any(map(len, (settled.a, settled.only_a, settled.only_b))):
            settled_to = max(settled_to, frontiers.of_all)
            yield settled


def pair_up(a: Rows, b: Rows, tolerance: float) -> tuple[Indices, Indices]:
    """Return the places of all pairs in *a* and in *b*, in the order of *a*; a key that is NaN has none."""
    is_key_a, is_key_b = np.isfinite(a.keys), np.isfinite(b.keys)
    if not is_key_a.any() or not is_key_b.any():
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    place_a, place_b = np.flatnonzero(is_key_a), np.flatnonzero(is_key_b)
    line_a, line_b = _on_one_line(a.take(place_a), b.take(place_b), tolerance)
    order_a, order_b = np.argsort(line_a, kind="stable"), np.argsort(line_b, kind="stable")
    sorted_a, sorted_b = line_a[order_a], line_b[order_b]
    partner = _nearest(sorted_a, sorted_b)
    is_mutual = _nearest(sorted_b, sorted_a)[partner] == np.arange(len(sorted_a))
    is_close = np.abs(sorted_b[partner] - sorted_a) <= tolerance
    found = np.flatnonzero(is_mutual & is_close)
    index_a, index_b = place_a[order_a[found]], place_b[order_b[partner[found]]]
    in_order = np.argsort(index_a, kind="stable")
    return index_a[in_order], index_b[in_order]


class _Side:
    """One stream as far as it is read."""

    def __init__(self, batches: Iterable[Rows], order: RecordOrder | None) -> None:
        self._batches = iter(batches)
        self._next: Rows | None = next(self._batches)
        self.held: Rows = self._next.take(np.empty(0, dtype=np.int64))
        self.order = order
        self.newest = self.lowest = -np.inf
        """Largest key of all that is read, and smallest of the batch that was read last."""
        self._back = 0.0 if order is None else order.back
        self._newest_of: dict[str, float] = {}
        self._left = {} if order is None else dict(order.counts)

    @property
    def has_ended(self) -> bool:
        """Whether everything is read."""
        return self._next is None

    @property
    def frontier(self) -> float:
        """Key that no record to come lies below, as far as keys went back until now, or will."""
        return np.inf if self.has_ended else self.newest - self._back

    def frontier_of(self, name: str) -> float:
        """Return the key that no record to come of one whom lies below; only of a stream whose order is known."""
        if self.order is None or self.has_ended or not self._left.get(name):
            return np.inf
        own = self._newest_of.get(name, -np.inf) - self.order.back_of_one
        return max(self.frontier, own)

    def read(self) -> None:
        """Take one batch more."""
        batch = self._next
        assert batch is not None
        self.held = batch if not len(self.held) else _join((self.held, batch))
        self.newest, back = gone_back(batch.keys, self.newest)
        self._back = max(self._back, back)
        is_key = np.isfinite(batch.keys)
        self.lowest = float(np.min(batch.keys, initial=np.inf, where=is_key))
        if self.order is not None:
            for name, keys in by_whom(batch.keys, batch.who):
                self._left[name] -= len(keys)
                self._newest_of[name], _ = gone_back(keys, self._newest_of.get(name, -np.inf))
        self._next = next(self._batches, None)


class _Frontiers:
    """Keys that no record to come lies below, in either stream."""

    def __init__(self, sides: tuple[_Side, _Side]) -> None:
        self._sides = sides
        self._is_by_whom = all(side.order is not None for side in sides)
        self.of_all = min(side.frontier for side in sides)
        if sum(len(side.held) for side in sides) > ROWS_HELD_MAX:
            self._is_by_whom = False
            self.of_all = min((s.newest for s in sides if not s.has_ended), default=np.inf)

    def of(self, rows: Rows) -> Floats:
        """Return the frontier of each row, shape (N,) or (1,)."""
        if not self._is_by_whom or not len(rows):
            return np.array([self.of_all])
        names, code = np.unique(rows.who.astype(str), return_inverse=True)
        found = [min(side.frontier_of(name) for side in self._sides) for name in names.tolist()]
        return np.array(found)[code]


def _settle(a: _Side, b: _Side, frontiers: _Frontiers, tolerance: float) -> Matched:
    """Match what is held, and keep what a record to come could still belong to."""
    rows_a, rows_b = a.held, b.held
    # Nearest of all is only sure where whatever comes lies further away. A key that is not a number will never find a partner.
    is_over_a, is_over_b = (
        ~(rows.keys > frontiers.of(rows) - tolerance) for rows in (rows_a, rows_b)
    )
    in_a = in_b = np.empty(0, dtype=np.int64)
    if is_over_a.any() or is_over_b.any():
        in_a, in_b = pair_up(rows_a, rows_b, tolerance)
    is_sure = is_over_a[in_a] & is_over_b[in_b]
    # Whoever has found a partner of which it is not sure yet is not alone: it waits with it.
    alone_a, keep_a = _others(is_over_a, in_a, is_sure)
    alone_b, keep_b = _others(is_over_b, in_b, is_sure)
    a.held, b.held = rows_a.take(keep_a), rows_b.take(keep_b)
    return Matched(
        a=rows_a.take(in_a[is_sure]),
        b=rows_b.take(in_b[is_sure]),
        only_a=rows_a.take(alone_a),
        only_b=rows_b.take(alone_b),
    )


def _others(
    is_over: NDArray[np.bool_], paired: Indices, is_sure: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks of what is surely alone, and of what is kept."""
    is_alone, is_kept = is_over.copy(), ~is_over
    is_alone[paired] = False
    is_kept[paired] = ~is_sure
    return is_alone, is_kept


def _on_one_line(a: Rows, b: Rows, tolerance: float) -> tuple[Floats, Floats]:
    """Return keys shifted so far apart for each whom and repetition that one search finds all pairs."""
    count = len(a)
    keys, who = np.concatenate((a.keys, b.keys)), np.concatenate((a.who, b.who))
    code = np.zeros(len(keys), dtype=np.int64)
    if len(who) and (who != who[0]).any():
        code = np.unique(who.astype(str), return_inverse=True)[1].astype(np.int64)
    repeated = np.concatenate((_repetition(a, code[:count]), _repetition(b, code[count:])))
    code = code * (int(repeated.max(initial=0)) + 1) + repeated
    low, apart = float(keys.min()), 4.0 * tolerance + 1.0
    length = (float(keys.max()) - low + apart) * (float(code.max()) + 1.0)
    if np.isfinite(length) and np.spacing(length) <= FINEST * tolerance:
        keys = keys - low
    else:
        keys = _drawn_together(keys, apart)
    line = keys + code * (float(keys.max()) + apart)
    return line[:count], line[count:]


def _drawn_together(keys: Floats, gap_max: float) -> Floats:
    """Return keys with the same distances up to *gap_max* from one to the next, and no larger ones."""
    different, place = np.unique(keys, return_inverse=True)
    with np.errstate(over="ignore"):  # as far apart as numbers go
        gaps = np.minimum(np.diff(different), gap_max)
    together: Floats = np.concatenate(([0.0], np.cumsum(gaps)))[place]
    return together


def _repetition(rows: Rows, code: Indices) -> Indices:
    """Return for each row how many before it have its key and whom."""
    keys = rows.keys
    order = np.lexsort((keys, code) if rows.ranks is None else (rows.ranks, keys, code))
    is_same = np.zeros(len(keys), dtype=np.bool_)
    is_same[1:] = (np.diff(keys[order]) == 0.0) & (np.diff(code[order]) == 0)
    place = np.arange(len(keys))
    start = np.maximum.accumulate(np.where(is_same, 0, place))
    result = np.empty(len(keys), dtype=np.int64)
    result[order] = place - start
    return result


def _nearest(values: Floats, among: Floats) -> Indices:
    """Return the place of the nearest of *among*, sorted and not empty, for each value."""
    right = np.clip(np.searchsorted(among, values), 0, len(among) - 1)
    left = np.maximum(right - 1, 0)
    is_left = np.abs(values - among[left]) <= np.abs(among[right] - values)
    return np.where(is_left, left, right)


def _join(parts: Sequence[Rows]) -> Rows:
    names = parts[0].columns
    ranks = [part.ranks for part in parts if part.ranks is not None]
    return Rows(
        keys=np.concatenate([part.keys for part in parts]),
        who=np.concatenate([part.who for part in parts]),
        columns={name: joined_column([p.columns[name] for p in parts]) for name in names},
        ranks=np.concatenate(ranks) if len(ranks) == len(parts) else None,
    )


def joined(batches: Iterable[Rows], rows_min: int) -> Iterator[Rows]:
    """Give the same rows in batches of at least *rows_min*, the last one apart."""
    held: list[Rows] = []
    for batch in batches:
        held.append(batch)
        if sum(map(len, held)) >= rows_min:
            yield _join(held)
            held = []
    if held:
        yield _join(held)
