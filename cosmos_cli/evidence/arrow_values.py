"""
Recorded values as Arrow arrays, each as its field's kind wants it.

Here and in tables nothing of pyarrow is called that computes (cast, dictionary_encode, filter, ...): the first such
call imports pyarrow.compute, a tenth of what a short run's command costs.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cosmos_cli.evidence.streams import Kind
from madns_runtime.plain_values import is_real
from madns_runtime.recording.columns import column_of

ARROW_TYPES: dict[Kind, pa.DataType] = {
    "float": pa.float64(),
    "int": pa.int64(),
    "bool": pa.bool_(),
    "str": pa.string(),
    "json": pa.string(),
    "packed": pa.string(),
}
NO_PLACES = np.empty(0, np.intp)


class _NoPandas:
    """Finder of modules that finds no pandas."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name=name)


def _leave_pandas_out() -> None:
    """
    Make an array while pandas cannot be imported, unless it is there already.

    pyarrow looks for pandas once, when it makes its first array, and imports it wherever it is installed:
    0.4 s of CPU per command for what nobody here uses. Who asks pyarrow for pandas gets it still.
    """
    if "pandas" in sys.modules:
        return
    finder: Any = _NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([None])
    finally:
        sys.meta_path.remove(finder)


_leave_pandas_out()


def to_arrow(values: NDArray[Any], kind: Kind) -> tuple[pa.Array, NDArray[np.intp]]:
    """Return a column as its field's kind wants it, and the places of those values that did not fit and became null."""
    if kind == "float" and values.dtype.kind in "fi":
        return floats_array(values), NO_PLACES
    if kind == "int" and values.dtype.kind == "i":
        return numbers_array(values.astype(np.int64, copy=False)), NO_PLACES
    if kind == "bool" and values.dtype.kind == "b":
        return _of_buffer(pa.bool_(), len(values), _bits(values), None), NO_PLACES
    if kind == "int" and values.dtype.kind == "f":
        is_null = np.isnan(values)
        is_beyond = (values >= 2.0**63) | (values < -(2.0**63))
        is_unfit = ~is_null & ((values != np.floor(values)) | is_beyond)
        whole = np.where(is_null | is_unfit, 0, values).astype(np.int64)
        return numbers_array(whole, is_null=is_null | is_unfit), np.flatnonzero(is_unfit)
    return _convert_each(values.tolist(), kind)


def floats_array(values: NDArray[Any]) -> pa.Array:
    """Return numbers as floats; NaN is null."""
    floats = values.astype(np.float64, copy=False)
    is_null = np.isnan(floats)
    return numbers_array(floats, is_null=is_null if is_null.any() else None)


def numbers_array(
    values: NDArray[Any],
    kind: pa.DataType | None = None,
    *,
    is_null: NDArray[np.bool_] | None = None,
) -> pa.Array:
    """Return numbers of an array as they lie in memory, as numpy's type or another of that size; some may be null."""
    return _of_buffer(
        kind or pa.from_numpy_dtype(values.dtype),
        len(values),
        np.ascontiguousarray(values),
        None if is_null is None else _bits(~is_null),
    )


def _of_buffer(
    kind: pa.DataType, count: int, values: NDArray[Any], is_known: NDArray[np.uint8] | None
) -> pa.Array:
    """Return *count* values from memory; `pa.array` would look whether they are masked, and import numpy.ma for that."""
    known = None if is_known is None else pa.py_buffer(is_known)
    return pa.Array.from_buffers(kind, count, [known, pa.py_buffer(values)])


def _bits(values: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.packbits(values, bitorder="little")


def to_codes(texts: Iterable[str | None]) -> pa.DictionaryArray:
    """Return texts, or nulls, as numbers of the texts that occur."""
    numbers: dict[str, int] = {}
    codes = [None if text is None else numbers.setdefault(text, len(numbers)) for text in texts]
    return pa.DictionaryArray.from_arrays(
        pa.array(codes, pa.int32()), pa.array(list(numbers), pa.string())
    )


def one_code(text: str | None, count: int) -> pa.DictionaryArray:
    """Return a text, or null, that all of *count* records have, likewise."""
    if text is None:
        return to_codes([None] * count)
    return pa.DictionaryArray.from_arrays(
        numbers_array(np.zeros(count, np.int32)), pa.array([text], pa.string())
    )


def to_times(utc_us: NDArray[np.int64], *, never_us: int) -> pa.Array:
    """Return UTC times, us, as such; *never_us* is null."""
    return numbers_array(utc_us, pa.timestamp("us", tz="UTC"), is_null=utc_us == never_us)


def to_numpy(column: pa.Array, *, is_exact: bool) -> NDArray[Any]:
    """Return a column as numpy has it; if *is_exact*, objects of whole numbers that no float is and that would become one."""
    if is_exact and column.null_count and pa.types.is_int64(column.type):
        return column_of(column.to_pylist(), "int")
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return values


def as_floats(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return a column as floats; what is no number is NaN."""
    if values.dtype.kind in "fi":
        return values.astype(np.float64)
    numbers = [v if is_real(v) else np.nan for v in values.tolist()]
    return np.array(numbers, dtype=np.float64)


def _convert_each(values: list[Any], kind: Kind) -> tuple[pa.Array, NDArray[np.intp]]:
    converted = [None if _is_null(value) else _convert(value, kind) for value in values]
    is_unfit = [
        new is None and not _is_null(old) for old, new in zip(values, converted, strict=True)
    ]
    return pa.array(converted, type=ARROW_TYPES[kind]), np.flatnonzero(is_unfit)


def _is_null(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _convert(value: Any, kind: Kind) -> Any:
    """Return a value as its kind has it; None where it is of another."""
    if kind == "float":
        return float(value) if is_real(value) else None
    if kind == "int":
        is_int64 = is_real(value) and value == int(value) and -(2**63) <= value < 2**63
        return int(value) if is_int64 else None
    if kind == "bool":
        return value if isinstance(value, bool) else None
    if isinstance(value, str) or kind == "str":
        return value if isinstance(value, str) else None
    try:
        return json.dumps(value)
    except RecursionError:  # orjson reads what is nested deeper than Python goes
        return None
