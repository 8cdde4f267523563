"""Differences of the fields of matched records: counted, squared, and the largest kept. Pure numpy."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.matching import Rows
from madns_runtime.analysis.sampling import as_array
from madns_runtime.recording.records import Field

TURN = {"deg": 360.0, "rad": 2.0 * math.pi}
"""A whole turn: angles differ by the shorter way round."""
TEXT_CHARACTERS_MAX = 60
SEPARATOR, NO_WORD = "\x1f", "\x1e"
"""Between the words that tell whom a record is about, and in the place of one: what no name holds."""
LARGE = 2**62
TURNS_MAX = 1e6
"""Further apart two values are no angles any more, but one that diverged: of 1e200 deg no float knows the rest."""


@dataclass(frozen=True, slots=True)
class RecordPlace:
    """Place of a finding: key of the record (tick or time), and whom it is about."""

    key: float
    who: str = ""

    def within(self, source: str) -> RecordPlace:
        """Return the same place among the records of several sources."""
        return RecordPlace(self.key, f"{source} {self.who}".strip())


class FieldDifference:
    """
    One field over all matched records of a stream.

    Args:
        field: The field, as the first run has it.
    """

    def __init__(self, field: Field) -> None:
        self.field = field
        self.different = 0
        """Records in which the values are not the same."""
        self.null_in_one = 0
        """Records in which only one has a value."""
        self.compared = 0
        """Records in which both have a number."""
        self.max = 0.0
        self.at: RecordPlace | None = None
        """Place of the largest difference; of texts, the first one."""
        self.first: RecordPlace | None = None
        """The first record that differs."""
        self.values: tuple[Any, Any] | None = None
        """Both values there."""
        self._squares = 0.0

    @property
    def is_number(self) -> bool:
        """Whether there is a difference to compute."""
        return self.field.kind in ("float", "int")

    @property
    def rms(self) -> float | None:
        """Root mean square of the differences; None without numbers."""
        return math.sqrt(self._squares / self.compared) if self.compared else None

    def add(self, a: Rows, b: Rows) -> None:
        """Take pairs of records, row for row."""
        left, right = a.columns[self.field.name], b.columns[self.field.name]
        if self.is_number:
            self._add_numbers(a, left, right)
        else:
            self._add_texts(a, left, right)

    def merge(self, other: FieldDifference, who: str) -> None:
        """Take what was found in another source's records of the same stream."""
        self.different += other.different
        self.null_in_one += other.null_in_one
        self.compared += other.compared
        self._squares += other._squares
        if other.first is not None and (self.first is None or other.first.key < self.first.key):
            self.first = other.first.within(who)
        if other.at is not None and (self.at is None or self._is_before(other, self.at, other.at)):
            self.max, self.values = other.max, other.values
            self.at = other.at.within(who)

    def _is_before(self, other: FieldDifference, at: RecordPlace, at_other: RecordPlace) -> bool:
        """Tell whether what another found is told in the place of what this did: it is larger; of texts, it comes first."""
        return other.max > self.max if self.is_number else at_other.key < at.key

    def _add_numbers(self, a: Rows, given: NDArray[Any], other: NDArray[Any]) -> None:
        left, right = as_array(given), as_array(other)
        is_one_null = np.isnan(left) != np.isnan(right)
        is_both = ~np.isnan(left) & ~np.isnan(right)
        with np.errstate(over="ignore"):  # of runs of which one diverged
            difference = np.where(is_both, left - right, 0.0)
        if self.field.kind == "int":
            exact = _exact_difference(given, other)
            difference = np.where(np.isnan(exact), difference, exact)
        turn = TURN.get(self.field.unit)
        if turn is not None:
            turns = np.abs(difference) / turn
            is_long = (turns > 0.5) & (turns < TURNS_MAX)
            difference[is_long] -= turn * np.round(difference[is_long] / turn)
        self.null_in_one += int(is_one_null.sum())
        self.compared += int(is_both.sum())
        with np.errstate(over="ignore"):  # of runs of which one diverged
            self._squares += float(np.dot(difference, difference))
        is_different = is_one_null | (difference != 0.0)
        self.different += int(is_different.sum())
        self._note_first(a, is_different)
        if len(difference):
            worst = int(np.abs(difference).argmax())
            size = abs(float(difference[worst]))
            if size > self.max:
                self.max, self.at = size, place_of(a, worst)
                self.values = (_number(given[worst]), _number(other[worst]))

    def _add_texts(self, a: Rows, left: NDArray[Any], right: NDArray[Any]) -> None:
        pairs = zip(left.tolist(), right.tolist(), strict=True)
        is_different = np.array([_differ(x, y, self.field.kind) for x, y in pairs], dtype=bool)
        self.different += int(is_different.sum())
        self._note_first(a, is_different)
        if self.values is None and is_different.any():
            index = int(is_different.argmax())
            self.at, self.values = place_of(a, index), (_told(left[index]), _told(right[index]))

    def _note_first(self, a: Rows, is_different: NDArray[np.bool_]) -> None:
        if self.first is None and is_different.any():
            self.first = place_of(a, int(is_different.argmax()))


def subject_of(words: Iterable[object]) -> str:
    """Return whom or what a record is about, by its words, each None where there is none: others are others."""
    return SEPARATOR.join(NO_WORD if word is None else str(word) for word in words)


def place_of(rows: Rows, index: int) -> RecordPlace:
    """Return where a record is."""
    who = rows.who[index]
    words = who.split(SEPARATOR) if isinstance(who, str) else ()
    return RecordPlace(float(rows.keys[index]), " ".join(w for w in words if w != NO_WORD))


def _exact_difference(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.float64]:
    """
    Return left - right of whole numbers, NaN where one is none.

    As floats two numbers above 2^53 are the same when they are not: nanoseconds of an epoch are such numbers.
    """
    if left.dtype.kind == right.dtype.kind == "i" and not (
        _is_large(left).any() or _is_large(right).any()
    ):
        return as_array(left - right)
    pairs = zip(left.tolist(), right.tolist(), strict=True)
    return np.array([float(x - y) if type(x) is type(y) is int else np.nan for x, y in pairs])


def _is_large(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Tell which whole numbers are so large that the difference of two might not fit 64 bits."""
    return (values >= LARGE) | (values < -LARGE)


def _number(value: Any) -> int | float:
    return int(value) if isinstance(value, int | np.integer) else float(value)


def _differ(left: Any, right: Any, kind: str) -> bool:
    """Tell whether two values that are no numbers are not the same; nested too deep to be compared, they are not."""
    if left is None or right is None or (isinstance(left, str) and left == right):
        return left is not right and left != right
    if kind == "bool":
        return bool(left != right) or isinstance(left, bool) != isinstance(right, bool)
    try:
        text = _canonical if kind == "json" else _as_in_table
        return text(left) != text(right)
    except RecursionError:
        return True


def _as_in_table(value: Any) -> str:
    """Return a text as it is, and what was recorded in its place as a table has it."""
    return value if isinstance(value, str) else json.dumps(value)


def _canonical(value: Any) -> str:
    """Return a JSON value, from a line or, as text, from a table, as the text that no other value has; 1 and 1.0 are one."""
    if isinstance(value, str):
        with contextlib.suppress(ValueError):  # a text as it is
            value = json.loads(value)
    return json.dumps(_with_whole_numbers(value), sort_keys=True)


def _with_whole_numbers(value: Any) -> Any:
    """Return a JSON value whose floats are ints where they are whole."""
    if isinstance(value, dict):
        return {key: _with_whole_numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_whole_numbers(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _told(value: Any) -> str | None:
    if value is None:
        return None
    try:
        text = value if isinstance(value, str) else json.dumps(value, default=str)
    except RecursionError:
        return "nested too deep to be shown"
    return text if len(text) <= TEXT_CHARACTERS_MAX else f"{text[: TEXT_CHARACTERS_MAX - 3]}..."
