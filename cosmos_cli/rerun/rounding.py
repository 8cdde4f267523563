"""
Differences that whole microseconds explain: recorded times are rounded to them, and a rerun plays back what is on record.

A position in orbit moves by some millimetres in that time, a field or an angle by less: 1e-8 of their size. That is of a
quantity's own size, as its agent recorded it, or of its vector's, never of whatever else has the unit; a whole number
moves by nothing. How fast a small remainder of large values moves, such as a distance kept, its own size does not tell:
it has to be the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from cosmos_cli.diff.fields import FieldDifference
from cosmos_cli.diff.recorded import Recorded
from cosmos_cli.rerun.device_comparison import SAME_TIME_S
from madns_runtime.analysis.sampling import as_array
from madns_runtime.recording.records import Field

ROUNDING_RATIO: Final = 1e-8
"""Of a vector's largest value: what half a microsecond moves within some ten seconds or more, such as a field or a position."""
AXES: Final = "xyzw"


def is_rounding(difference: FieldDifference, recorded: Recorded) -> bool:
    """
    Tell whether a field's values differ by no more than what follows from times in whole microseconds.

    Args:
        difference: What was found in the records of one source.
        recorded: These records.

    Raises:
        MachineError: A file cannot be read.
    """
    field = difference.field
    if field.kind != "float" or difference.null_in_one:
        return False
    if field.unit == "s":
        return difference.max <= SAME_TIME_S
    names = [one.name for one in _vector_of(field, recorded)]
    largest = 0.0
    for columns in recorded.batches(names):
        for name in names:
            values = np.abs(as_array(columns[name]))
            largest = max(largest, float(np.nanmax(values, initial=0.0)))
    return difference.max <= ROUNDING_RATIO * largest


def _vector_of(field: Field, recorded: Recorded) -> Iterator[Field]:
    """Give a field and the other elements of its vector: named alike but for an axis or a digit, of the same unit."""
    for one in recorded.fields:
        if (one.unit, one.kind) == (field.unit, field.kind) and _is_alike(one.name, field.name):
            yield one


def _is_alike(name: str, other: str) -> bool:
    """Tell whether two names are the same but for one axis, or one digit."""
    if len(name) != len(other):
        return False
    pairs = [(x, y) for x, y in zip(name, other, strict=True) if x != y]
    are_axes = all(x in AXES and y in AXES for x, y in pairs)
    return len(pairs) <= 1 and (are_axes or all(x.isdigit() and y.isdigit() for x, y in pairs))
