"""
Fit of an ellipsoid to vectors whose strength is one and the same, however the sensor lay. Pure.

Least squares of | shape raw - offset | - strength by Gauss-Newton, from the algebraic fit, which is linear. *shape* is a
diagonal (scale) or a symmetric matrix. Vectors are divided by their spread first, so that no unit costs digits.
Source of the algebraic start: Gander, Golub and Strebel, Least-squares fitting of circles and ellipses, BIT 34 (1994).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from madns_runtime.hardware.calibration.result import Floats

ITERATIONS_MAX: Final = 50
STEP_MIN: Final = 1e-12
"""Relative change at which the search ends."""
CONDITION_MAX: Final = 1e6
"""Of the normal equations' columns at unit length: beyond, some number of the shape is free."""
UPPER: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Places of a symmetric matrix's numbers; the first three are a diagonal's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EllipsoidFit:
    """Matrix and offset with which all vectors have one strength: shape raw - offset."""

    shape: Floats
    """(3, 3), symmetric."""
    shape_sigmas: Floats
    offset: Floats
    """In the vectors' unit after the shape."""
    offset_sigmas: Floats
    residuals: Floats
    """Strengths that the fit leaves beside the one given, shape (N,), in the vectors' unit."""
    parameters: int

    @property
    def squares(self) -> float:
        """Sum of the residuals' squares."""
        return float(self.residuals @ self.residuals)

    def directions(self, vectors: Floats) -> Floats:
        """Return the vectors as directions of unit length, about."""
        turned = vectors @ self.shape.T - self.offset
        return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def plane_of(vectors: Floats) -> Floats | None:
    """Return the normal of the plane in which vectors lie, as far as they do; None if they fill space."""
    centred = vectors - vectors.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    return np.asarray(axes[2]) if sizes[2] < FLATNESS_MAX * sizes[0] else None


FLATNESS_MAX: Final = 0.1
"""Thickness of a cloud of vectors as a share of its width, below which it is a disc."""


def fit_ellipsoid(
    vectors: Floats, strength: float, *, is_full: bool, sigma: float | None = None
) -> EllipsoidFit | None:
    """
    Return the best fit; None if the vectors do not tell one.

    Args:
        vectors: Shape (N, 3).
        strength: That all of them have in truth, in the unit that the fit is to give.
        is_full: Whether the shape may have numbers off its diagonal.
        sigma: Standard deviation of one vector's strength, where it is known; None to take it from what the fit leaves.
    """
    places = UPPER if is_full else UPPER[:3]
    count = len(places) + 3
    if len(vectors) < count:
        return None
    spread = float(np.sqrt(np.mean(np.var(vectors, axis=0))))
    if not spread > 0.0:
        return None
    points = vectors / spread
    start = _algebraic(points)
    if start is None:
        return None
    scale, offset = start
    numbers = np.concatenate([scale, np.zeros(len(places) - 3), offset])
    for _ in range(ITERATIONS_MAX):
        residuals, slopes = _linearised(points, numbers, places)
        if not np.isfinite(slopes).all():
            return None
        step = np.linalg.lstsq(slopes, -residuals, rcond=None)[0]
        numbers = numbers + step
        if np.linalg.norm(step) <= STEP_MIN * np.linalg.norm(numbers):
            break
    residuals, slopes = _linearised(points, numbers, places)
    covariance = _covariance(slopes)
    if covariance is None or not (numbers[:3] > 0.0).all():
        return None
    spare = len(points) - count
    if sigma is None:
        variance = float(residuals @ residuals) / spare if spare > 0 else np.nan
    else:
        variance = (sigma / strength) ** 2
    sigmas = np.sqrt(np.diag(covariance) * variance)
    # Of points: strength 1. Of vectors: their unit.
    to_shape = strength / spread
    return EllipsoidFit(
        shape=_matrix(numbers, places) * to_shape,
        shape_sigmas=_matrix(sigmas, places) * to_shape,
        offset=numbers[-3:] * strength,
        offset_sigmas=sigmas[-3:] * strength,
        residuals=residuals * strength,
        parameters=count,
    )


def _algebraic(points: Floats) -> tuple[Floats, Floats] | None:
    """Return scale and offset of an ellipsoid along the axes by linear least squares; None if it is none."""
    design = np.hstack([points**2, -2.0 * points])
    solution = np.linalg.lstsq(design, np.ones(len(points)), rcond=None)[0]
    squares, linear = solution[:3], solution[3:]
    if not (squares > 0.0).all():
        # Few directions, or noise: a sphere is what remains.
        design = np.hstack([2.0 * points, np.ones((len(points), 1))])
        centre = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
        radius2 = float(centre[3] + centre[:3] @ centre[:3])
        if not radius2 > 0.0:
            return None
        scale = np.full(3, radius2**-0.5)
        return scale, scale * centre[:3]
    centre = linear / squares
    right = 1.0 + float(squares @ centre**2)
    scale = np.sqrt(squares / right)
    return scale, scale * centre


def _linearised(
    points: Floats, numbers: Floats, places: tuple[tuple[int, int], ...]
) -> tuple[Floats, Floats]:
    """Return what is left of strength 1 at each point, and how it changes with each number."""
    turned = points @ _matrix(numbers, places).T - numbers[-3:]
    lengths = np.linalg.norm(turned, axis=1)
    units = turned / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    columns = []
    for row, column in places:
        slope = units[:, row] * points[:, column]
        if row != column:
            slope = slope + units[:, column] * points[:, row]
        columns.append(slope)
    return lengths - 1.0, np.column_stack([*columns, -units])


def _covariance(slopes: Floats) -> Floats | None:
    """Return the inverse of the normal equations; None if some number, or a mix of them, is free."""
    lengths = np.linalg.norm(slopes, axis=0)
    if not (lengths > 0.0).all():
        return None
    _, sizes, axes = np.linalg.svd(slopes / lengths, full_matrices=False)
    if sizes[-1] * CONDITION_MAX**0.5 < sizes[0]:
        return None
    inverse = (axes.T / sizes**2) @ axes
    return np.asarray(inverse / np.outer(lengths, lengths))


def _matrix(numbers: Floats, places: tuple[tuple[int, int], ...]) -> Floats:
    matrix = np.zeros((3, 3))
    for (row, column), number in zip(places, numbers, strict=False):
        matrix[row, column] = matrix[column, row] = number
    return matrix
