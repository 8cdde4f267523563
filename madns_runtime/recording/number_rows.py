"""
Rounding and encoding of records that are numbers alone: one by one as they come, or many at once for a third of the time.

Both ways give the same bytes: every number is the nearest float of its decimals, as Python's own `round` says. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np
import orjson

from madns_runtime.recording.encoding import ENCODING

ROWS_TOGETHER = 128
"""Records that are encoded at once: more of them gain nothing."""
_DOUBT = 2.0**-51
"""Of a number times a power of ten: twice the rounding of that product, relative."""


class NumberRows:
    """
    The records of one stream on their way to be text.

    Args:
        digits: Of each field the decimal places kept; None for an int.
    """

    __slots__ = ("_columns", "_digits", "_kinds", "_powers", "waiting")

    def __init__(self, digits: Sequence[int | None]) -> None:
        self.waiting: list[tuple[Any, ...]] = []
        """Records that are not encoded yet, each as wide as the stream."""
        self._digits = tuple(digits)
        self._kinds = [int if places is None else float for places in digits]
        self._columns = [at for at, places in enumerate(digits) if places is not None]
        self._powers = np.array([10.0 ** (places or 0) for places in digits])[self._columns]

    def is_fit(self, row: object) -> TypeGuard[tuple[Any, ...]]:
        """Tell whether a record is a tuple of the numbers that its fields hold: others are encoded, or refused, at once."""
        return type(row) is tuple and list(map(type, row)) == self._kinds

    def rounded(self, row: Sequence[Any]) -> list[Any]:
        """Return one record as it is encoded."""
        return [
            round(float(value), places)
            if isinstance(value, float) and places is not None
            else value  # of an int a float is no value, as elsewhere
            for value, places in zip(row, self._digits, strict=True)
        ]

    def encode(self) -> tuple[list[bytes], int]:
        """
        Return a line for every record that waits, and how many of their numbers are not finite.

        Raises:
            TypeError: A value is no float, or no int where one belongs: each has to be encoded by itself.
        """
        columns: list[Any] = list(zip(*self.waiting, strict=True))
        for at, kind in enumerate(self._kinds):
            if set(map(type, columns[at])) != {kind}:
                raise TypeError(f"value {at}: expected {kind.__name__} alone")
        values = np.array([columns[at] for at in self._columns]).T
        not_finite = int(values.size - np.count_nonzero(np.isfinite(values)))
        for at, column in zip(self._columns, self._round(values).T.tolist(), strict=True):
            columns[at] = column
        lines = [orjson.dumps(row, None, ENCODING) for row in zip(*columns, strict=True)]
        self.waiting = []
        return lines, not_finite

    def _round(self, values: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
        """
        Return the nearest floats of the values' decimals.

        A whole number below 2^53 over a power of ten is such a float. Which whole number is beyond doubt unless
        the product lies within its own rounding of the middle between two; then, and for what is not finite,
        `round` decides.
        """
        with np.errstate(all="ignore"):  # a plug-in may have numpy raise
            scaled = values * self._powers
            whole = np.rint(scaled)
            is_clear = 0.5 - np.abs(scaled - whole) > _DOUBT * np.abs(scaled)
        result = whole / self._powers
        for row, at in np.argwhere(~is_clear).tolist():
            value, places = float(values[row, at]), self._digits[self._columns[at]]
            result[row, at] = round(value, places) if math.isfinite(value) else value
        return result
