"""One stream of one source in both runs: its records matched, and what differs in them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any, Literal

import numpy as np

from cosmos_cli.diff.fields import FieldDifference, RecordPlace, place_of, subject_of
from cosmos_cli.diff.recorded import ROWS_READ_MAX, Recorded
from madns_runtime.analysis.matching import KeyWentBackError, Matched, Orders, Rows, joined, match
from madns_runtime.analysis.record_order import RecordOrder, learn_order
from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.values import Floats
from madns_runtime.recording.records import NUMBER_KINDS, Field

TICK_TOLERANCE = 0.25
"""Ticks are whole numbers."""
SAME_TIME_S = 1e-6
"""Of ticks at different rates those are matched that mean the same instant, s."""
IDENTITY = ("agent", "satellite", "sender", "to", "receiver", "station", "kind", "event")
"""Text fields that tell whom or what a record is about, whatever its stream: records match only where they agree."""
TIMES = ("t_s", "commanded_s", "sent_s", "rise_s", "at_s")
"""Fields of a time, in the order in which they are tried."""
PACKET = "packet"
"""Field that numbers one message every tick, where nothing tells the time; beside a time it numbers something else."""
RANK = "number"
"""Field of a record's own number: those of one time are pairs in its order, whenever each was recorded."""
OWNERS = ("agent", "sender")
"""Of these the first is the agent that a record of the host belongs to."""
By = Literal["tick", "time", "order"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairing:
    """Way in which records of a stream find each other."""

    by: By
    column: str
    """Field that holds the key; empty for the number of the record."""
    scales: tuple[float, float] = (1.0, 1.0)
    """Factors of the key, in the first and in the second run."""
    tolerance: float = TICK_TOLERANCE
    identity: tuple[str, ...] = ()
    rank: str = ""
    """Field that numbers the records of one time and whom, which a host may record in any order; empty for none."""


@dataclass(slots=True, kw_only=True)
class Alone:
    """Records that only one run has."""

    count: int = 0
    first: RecordPlace | None = None
    last: RecordPlace | None = None

    def add(self, rows: Rows) -> None:
        """Count them; the first and the last by key are kept."""
        if len(rows):
            keys = np.where(np.isfinite(rows.keys), rows.keys, 0.0)
            first, last = place_of(rows, int(keys.argmin())), place_of(rows, int(keys.argmax()))
            self._take(len(rows), first, last)

    def merge(self, other: Alone, who: str) -> None:
        """Take those of another source."""
        if other.first is not None and other.last is not None:
            self._take(other.count, other.first.within(who), other.last.within(who))

    def _take(self, count: int, first: RecordPlace, last: RecordPlace) -> None:
        self.count += count
        if self.first is None or first.key < self.first.key:
            self.first = first
        if self.last is None or last.key > self.last.key:
            self.last = last


@dataclass(slots=True, kw_only=True)
class StreamDifference:
    """Result of the comparison of one stream; of one source, or of all together."""

    table: str
    source: str
    by: By = "tick"
    rows_a: int = 0
    rows_b: int = 0
    matched: int = 0
    is_identical: bool = False
    """Whether the records are the same bit by bit, by their hashes, or, without lines, by their values."""
    only_a: Alone = field(default_factory=Alone)
    only_b: Alone = field(default_factory=Alone)
    fields: dict[str, FieldDifference] = field(default_factory=dict)
    fields_only_a: tuple[str, ...] = ()
    fields_only_b: tuple[str, ...] = ()

    @property
    def has_same_values(self) -> bool:
        """Whether every record has its partner, with the same values."""
        return (
            not self.only_a.count
            and not self.only_b.count
            and not self.fields_only_a
            and not self.fields_only_b
            and not any(found.different for found in self.fields.values())
        )

    def merge(self, other: StreamDifference) -> None:
        """Take what was found for another source of the same stream."""
        self.rows_a += other.rows_a
        self.rows_b += other.rows_b
        self.matched += other.matched
        self.is_identical = self.is_identical and other.is_identical
        # A record of the host names its agent itself.
        who = "" if other.source == "host" else other.source
        self.only_a.merge(other.only_a, who)
        self.only_b.merge(other.only_b, who)
        for name, found in other.fields.items():
            self.fields.setdefault(name, FieldDifference(found.field)).merge(found, who)
        self.fields_only_a = _union(self.fields_only_a, other.fields_only_a)
        self.fields_only_b = _union(self.fields_only_b, other.fields_only_b)


def choose_pairing(a: Sequence[Field], b: Sequence[Field], tick_hz: tuple[float, float]) -> Pairing:
    """
    Return how the records of a stream with these fields find each other.

    By tick where both runs tick alike, at different rates by the instant that a tick means; what has no
    tick by its time, to half a tick; what has no time by its number.
    """
    common = {f.name: f for f in a if any((f.name, f.unit) == (o.name, o.unit) for o in b)}
    identity = tuple(n for n in IDENTITY if n in common and common[n].kind == "str")
    numbers = {name for name, one in common.items() if one.kind in NUMBER_KINDS}
    time = next((name for name in TIMES if name in numbers), None)
    ticks = ("tick",) if time is not None else ("tick", PACKET)
    tick = next((name for name in ticks if name in numbers), None)
    if tick is not None and tick_hz[0] == tick_hz[1]:
        return Pairing(by="tick", column=tick, identity=identity)
    if tick is not None:
        scales = (1.0 / tick_hz[0], 1.0 / tick_hz[1])
        return Pairing(
            by="time", column=tick, scales=scales, tolerance=SAME_TIME_S, identity=identity
        )
    if time is not None:
        rank = RANK if RANK in numbers else ""
        tolerance = 0.5 / max(tick_hz)
        return Pairing(by="time", column=time, tolerance=tolerance, identity=identity, rank=rank)
    return Pairing(by="order", column="", identity=())


def tell_apart(a: Recorded, b: Recorded, pairing: Pairing) -> Pairing:
    """
    Return the pairing with the text fields besides that tell records of one time apart, such as a plug-in's `rover`.

    The records show which: of the first piece of each run, fewer are alike with such a field.

    Raises:
        MachineError: A file cannot be read.
    """
    others = {(field.name, field.kind) for field in b.fields}
    texts = [f.name for f in a.fields if f.kind == "str" and (f.name, f.kind) in others]
    texts = [name for name in texts if name not in pairing.identity]
    if pairing.by == "order" or not texts:
        return pairing
    names = (pairing.column, *pairing.identity, *texts)
    pieces = [
        next(iter(one.batches(names)), {name: np.empty(0) for name in names}) for one in (a, b)
    ]

    def alike(identity: tuple[str, ...]) -> int:
        return sum(_repeated(piece, pairing.column, identity) for piece in pieces)

    identity, left = pairing.identity, alike(pairing.identity)
    for name in texts:
        if left and (fewer := alike((*identity, name))) < left:
            identity, left = (*identity, name), fewer
    return replace(pairing, identity=identity)


def _repeated(columns: Mapping[str, Any], key: str, identity: tuple[str, ...]) -> int:
    """Return how many records another one precedes that is of the same time and about the same."""
    keys = columns[key].tolist()
    who = _who(columns, identity, len(keys)).tolist()
    return len(keys) - len(set(zip(keys, who, strict=True)))


def diff_stream(
    a: Recorded,
    b: Recorded,
    pairing: Pairing,
    *,
    agents: Sequence[str],
) -> StreamDifference:
    """
    Compare one stream of one source, in bounded memory.

    Args:
        a: The stream in the first run.
        b: The same stream in the second.
        pairing: How its records find each other.
        agents: Globs of the agents whose records count, where they are one of many; empty for all.

    Raises:
        MachineError: A file cannot be read.
    """
    pairing = tell_apart(a, b, pairing)
    try:
        return _diff(a, b, pairing, agents, None)
    except KeyWentBackError:
        scaled = zip((a, b), pairing.scales, strict=True)
        first, second = (_order(one, pairing, scale, agents) for one, scale in scaled)
        return _diff(a, b, pairing, agents, (first, second))


def _diff(
    a: Recorded, b: Recorded, pairing: Pairing, agents: Sequence[str], orders: Orders | None
) -> StreamDifference:
    """
    Compare one stream, without *orders* as its keys grow.

    Raises:
        KeyWentBackError: They do not, so that the orders have to be known.
        MachineError: A file cannot be read.
    """
    units_a, units_b = ({f.name: f.unit for f in one.fields} for one in (a, b))
    names = tuple(n for n in a.names() if n in b.names() and units_a[n] == units_b[n])
    keys = (pairing.column, *pairing.identity)
    values = [f for f in a.fields if f.name in names and f.name not in keys]
    found = StreamDifference(
        table=a.table,
        source=a.source,
        by=pairing.by,
        fields={f.name: FieldDifference(f) for f in values},
        fields_only_a=_others_of(a, names, units_b),
        fields_only_b=_others_of(b, names, units_a),
    )
    sides = (
        _rows(a, names, pairing, scale=pairing.scales[0], agents=agents),
        _rows(b, names, pairing, scale=pairing.scales[1], agents=agents),
    )
    for piece in match(*sides, tolerance=pairing.tolerance, orders=orders, must_wait=True):
        _take(found, piece)
    found.is_identical = found.has_same_values and not (a.files or b.files)
    return found


def _order(
    recorded: Recorded, pairing: Pairing, scale: float, agents: Sequence[str]
) -> RecordOrder:
    """Return in which order a stream's records stand, by what tells how they find each other alone."""
    needed = (pairing.column, pairing.rank, *pairing.identity, *OWNERS)
    names = tuple(name for name in recorded.names() if name in needed)
    rows = _rows(recorded, names, pairing, scale=scale, agents=agents)
    return learn_order((batch.keys, batch.who) for batch in rows)


def _others_of(
    recorded: Recorded, names: Sequence[str], known: Mapping[str, str]
) -> tuple[str, ...]:
    """Return the fields that only this run has; of those that the other has in another unit with theirs, as `x (km)`."""
    return tuple(
        f"{field.name} ({field.unit})" if field.name in known else field.name
        for field in recorded.fields
        if field.name not in names
    )


def identical_stream(a: Recorded, by: By, records: int) -> StreamDifference:
    """Return what is found where the hashes of all records agree."""
    return StreamDifference(
        table=a.table,
        source=a.source,
        by=by,
        rows_a=records,
        rows_b=records,
        matched=records,
        is_identical=True,
    )


def _take(found: StreamDifference, piece: Matched) -> None:
    found.matched += len(piece.a)
    found.rows_a += len(piece.a) + len(piece.only_a)
    found.rows_b += len(piece.b) + len(piece.only_b)
    found.only_a.add(piece.only_a)
    found.only_b.add(piece.only_b)
    if len(piece.a):
        for one in found.fields.values():
            one.add(piece.a, piece.b)


def _rows(
    recorded: Recorded,
    names: tuple[str, ...],
    pairing: Pairing,
    *,
    scale: float,
    agents: Sequence[str],
) -> Iterator[Rows]:
    """Give a stream's records in batches, the first of them empty if there are none."""
    owner = next((n for n in OWNERS if n in names), None) if recorded.role == "host" else None
    names = names or recorded.names()[:1]  # without a common field records are counted all the same
    chosen: dict[str, bool] = {}
    counted = 0

    def rows_of(columns: Mapping[str, Any]) -> Rows:
        nonlocal counted
        if agents and owner is not None:
            columns = _chosen(columns, owner, agents, chosen)
        count = len(columns[names[0]])
        keys = _keys(columns, pairing, counted, count) * scale
        counted += count
        ranks = as_array(columns[pairing.rank]) if pairing.rank else None
        who = _who(columns, pairing.identity, count)
        return Rows(keys=keys, who=who, columns=dict(columns), ranks=ranks)

    batches = (rows_of(columns) for columns in recorded.batches(names))
    is_empty = True
    for rows in joined(batches, ROWS_READ_MAX):
        is_empty = False
        yield rows
    if is_empty:
        nothing = {name: np.empty(0, dtype=object) for name in names}
        yield Rows(keys=np.empty(0), who=np.empty(0, dtype=object), columns=nothing)


def _chosen(
    columns: Mapping[str, Any], owner: str, agents: Sequence[str], known: dict[str, bool]
) -> Mapping[str, Any]:
    """Return the records whose owner a glob fits; *known* keeps which do."""
    owners = columns[owner].tolist()
    for name in owners:
        if name not in known:
            known[name] = any(fnmatchcase(str(name), glob) for glob in agents)
    is_chosen = np.array([known[name] for name in owners], dtype=bool)
    return {name: values[is_chosen] for name, values in columns.items()}


def _keys(columns: Mapping[str, Any], pairing: Pairing, counted: int, count: int) -> Floats:
    if not pairing.column:
        return np.arange(counted, counted + count, dtype=np.float64)
    return as_array(columns[pairing.column])


def _who(columns: Mapping[str, Any], identity: tuple[str, ...], count: int) -> Any:
    """Return whom each record is about; all the same without a field that tells."""
    if not identity:
        return np.zeros(count, dtype=np.int8)
    parts = [columns[name].tolist() for name in identity]
    who = np.empty(count, dtype=object)
    who[:] = [subject_of(row) for row in zip(*parts, strict=True)]
    return who


def _union(first: tuple[str, ...], second: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*first, *second)))
