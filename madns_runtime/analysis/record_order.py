"""How far the keys of a stream go back: most grow, but a host may write one agent's history after the other's. Pure numpy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.values import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordOrder:
    """Order of a stream's records, as reading all of their keys tells."""

    back: float
    """Farthest that a key lies below one before it."""
    back_of_one: float
    """The same among the records of one whom."""
    counts: Mapping[str, int]
    """Records of each whom."""


def learn_order(batches: Iterable[tuple[Floats, NDArray[Any]]]) -> RecordOrder:
    """Return the order of records of these keys and whoms, in the order of recording."""
    newest, back, back_of_one = -np.inf, 0.0, 0.0
    newest_of: dict[str, float] = {}
    counts: Counter[str] = Counter()
    for keys, who in batches:
        newest, far = gone_back(keys, newest)
        back = max(back, far)
        for name, own in by_whom(keys, who):
            counts[name] += len(own)
            newest_of[name], far = gone_back(own, newest_of.get(name, -np.inf))
            back_of_one = max(back_of_one, far)
    return RecordOrder(back=back, back_of_one=back_of_one, counts=counts)


def gone_back(keys: Floats, newest: float) -> tuple[float, float]:
    """Return the largest of *newest* and all keys, and how far a key lies at most below one before it."""
    told = keys[np.isfinite(keys)]
    if not len(told):
        return newest, 0.0
    largest = np.maximum.accumulate(np.concatenate(([newest], told)))[1:]
    with np.errstate(over="ignore"):  # as far apart as numbers go
        return float(largest[-1]), float((largest - told).max())


def by_whom(keys: Floats, who: NDArray[Any]) -> Iterator[tuple[str, Floats]]:
    """Give the keys of each whom, in the order of recording."""
    names, code = np.unique(who.astype(str), return_inverse=True)
    ends = np.cumsum(np.bincount(code, minlength=len(names)))
    parts = np.split(keys[np.argsort(code, kind="stable")], ends[:-1])
    if len(names):
        yield from zip(names.tolist(), parts, strict=True)
