"""
How a device sits in a vehicle: from its axes to the body's, as a scenario gives it. Pure.

Standard library alone: `cosmos validate` asks here as well as the vehicle.
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Alignment = Matrix | tuple[float, float, float, float] | None

IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
LENGTH_TOLERANCE = 1e-3
"""Of a quaternion, and of a rotation's rows: people write four digits."""
DETERMINANT_MIN = 1e-6
"""Of a matrix whose rows have unit length: below, axes fall together and a direction is lost."""


def matrix_of(alignment: Alignment) -> Matrix:
    """Return the matrix that takes components in the device's axes to those in the body's."""
    if alignment is None:
        return IDENTITY
    if len(alignment) == 3:
        return alignment
    length = math.hypot(*alignment)
    x, y, z, w = (number / length for number in alignment)
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)),
        (2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)),
        (2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)),
    )


def alignment_fault(alignment: Alignment, *, must_turn: bool) -> str | None:
    """
    Return what is wrong with an alignment; None if nothing is.

    Args:
        alignment: Of a device.
        must_turn: Whether it must be a rotation: nothing else aligns a quaternion.
    """
    if alignment is None:
        return None
    numbers = [
        number for row in alignment for number in (row if isinstance(row, tuple) else (row,))
    ]
    if not all(map(math.isfinite, numbers)):
        return "expected finite numbers"
    if len(alignment) == 4:
        length = math.hypot(*alignment)
        if abs(length - 1.0) <= LENGTH_TOLERANCE:
            return None
        return f"expected a quaternion of length 1, scalar last, got the length {length:g}"
    lengths = [math.hypot(*row) for row in alignment]
    determinant = _determinant(alignment)
    if min(lengths) <= 0.0 or abs(determinant) < DETERMINANT_MIN * math.prod(lengths):
        return "expected a matrix that loses no direction: two of its rows are parallel, or one is zero"
    is_rotation = abs(determinant - 1.0) < 3 * LENGTH_TOLERANCE and all(
        abs(length - 1.0) < LENGTH_TOLERANCE for length in lengths
    )
    if must_turn and not is_rotation:
        return f"expected a rotation (rows of length 1, determinant 1), got the determinant {determinant:g}"
    return None


def _determinant(matrix: Matrix) -> float:
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
