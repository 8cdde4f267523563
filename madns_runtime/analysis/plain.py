"""Values of figures as plain mappings, lists and scalars, and back: how they come from a process of their own."""

from __future__ import annotations

import base64
import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from madns_runtime.analysis import values

KIND, ARRAY, SHAPE, NUMBER = "kind", "array", "shape", "number"
KINDS = {
    name: kind
    for name, kind in vars(values).items()
    if isinstance(kind, type) and dataclasses.is_dataclass(kind)
}


def to_plain(value: Any) -> Any:
    """
    Return a value of a figure, or several, as JSON can hold it.

    Raises:
        TypeError: It holds what no figure is made of.
    """
    if KINDS.get(type(value).__name__) is type(value):
        fields = {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {KIND: type(value).__name__, "fields": fields}
    if isinstance(value, np.ndarray):
        if type(value) is not np.ndarray or value.dtype.kind != "f":
            # Of a document: as floats, whole numbers would lose their last digits, and what a mask hides would show.
            return to_plain(value.tolist())
        data = np.ascontiguousarray(value, dtype="<f8")
        text = base64.b64encode(data.tobytes()).decode("ascii")
        return {KIND: ARRAY, "data": text, SHAPE: list(value.shape)}
    if isinstance(value, np.generic):
        return to_plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {KIND: NUMBER, "text": repr(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {KIND: "mapping", "items": _items(value)}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    raise TypeError(f"figures hold numbers, texts and values of theirs, got {type(value).__name__}")


def _items(mapping: Mapping[Any, Any]) -> dict[str, Any]:
    """
    Return a mapping's items by texts, as JSON has them.

    Raises:
        TypeError: Two keys have one text, so that one of them would be lost.
    """
    items: dict[str, Any] = {}
    for key, item in mapping.items():
        if str(key) in items:
            raise TypeError(
                f"a mapping's keys are texts in JSON, and two of one are {str(key)!r:.80}: give them other names"
            )
        items[str(key)] = to_plain(item)
    return items


def from_plain(plain: Any) -> Any:
    """
    Return what `to_plain` made plain.

    Raises:
        ValueError: It does not fit together.
    """
    if isinstance(plain, list):
        return [from_plain(item) for item in plain]
    if not isinstance(plain, Mapping):
        return plain
    kind = plain[KIND]
    if kind == ARRAY:
        data = np.frombuffer(base64.b64decode(plain["data"]), dtype="<f8")
        return data.reshape(plain[SHAPE])
    if kind == NUMBER:
        return float(plain["text"])
    if kind == "mapping":
        return {key: from_plain(item) for key, item in plain["items"].items()}
    return KINDS[kind](**{name: from_plain(item) for name, item in plain["fields"].items()})
