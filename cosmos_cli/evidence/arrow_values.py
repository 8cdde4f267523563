"""Recorded values as Arrow arrays, each as its field's kind wants it."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cosmos_cli.evidence.streams import Kind
from madns_runtime.recording.columns import column_of

ARROW_TYPES: dict[Kind, pa.DataType] = {
    "float": pa.float64(),
    "int": pa.int64(),
    "bool": pa.bool_(),
    "str": pa.string(),
    "json": pa.string(),
    "packed": pa.string(),
}


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


def to_arrow(values: NDArray[Any], kind: Kind) -> tuple[pa.Array, int]:
    """Return a column as its field's kind wants it, and how many values did not fit and became null."""
    if kind == "float" and values.dtype.kind in "fi":
        return pa.array(values.astype(np.float64, copy=False), from_pandas=True), 0
    if kind == "int" and values.dtype.kind == "i":
        return pa.array(values), 0
    if kind == "bool" and values.dtype.kind == "b":
        return pa.array(values), 0
    if kind == "int" and values.dtype.kind == "f":
        is_null = np.isnan(values)
        is_unfit = ~is_null & ((values != np.floor(values)) | (np.abs(values) >= 2.0**63))
        whole = np.where(is_null | is_unfit, 0, values).astype(np.int64)
        return pa.array(whole, mask=is_null | is_unfit), int(is_unfit.sum())
    return _convert_each(values.tolist(), kind)


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
    numbers = [v if _is_number(v) else np.nan for v in values.tolist()]
    return np.array(numbers, dtype=np.float64)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _convert_each(values: list[Any], kind: Kind) -> tuple[pa.Array, int]:
    converted = [_convert(value, kind) for value in values]
    unfit = sum(new is None and old is not None for old, new in zip(values, converted, strict=True))
    return pa.array(converted, type=ARROW_TYPES[kind]), unfit


def _convert(value: Any, kind: Kind) -> Any:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return None
    if kind == "float":
        return float(value) if _is_number(value) else None
    if kind == "int":
        is_int64 = _is_number(value) and value == int(value) and abs(value) < 2**63
        return int(value) if is_int64 else None
    if kind == "bool":
        return value if isinstance(value, bool) else None
    try:
        return value if isinstance(value, str) else json.dumps(value)
    except RecursionError:  # orjson reads what is nested deeper than Python goes
        return None
