"""
DOP853 for one rigid body in a few calls of numpy: a third of the time of scipy's, which is made for many numbers.

Coefficients, error estimate, choice of steps and values between them are scipy's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MissingExtraError

try:
    from scipy.integrate import DOP853
except ImportError as error:
    raise MissingExtraError("scipy", "host") from error

Array = NDArray[np.float64]
Derivative = Callable[[float, list[float]], Sequence[float]]
"""Of the time after the first one, s, and the numbers."""

STAGES = 12
_WEIGHTS: list[Array] = [DOP853.A[stage, :stage].copy() for stage in range(STAGES)]
_NODES: list[float] = DOP853.C.tolist()
_EXTRA = [
    (DOP853.A_EXTRA[row, : STAGES + 1 + row].copy(), float(DOP853.C_EXTRA[row])) for row in range(3)
]
_RESULT: Array = DOP853.B
_ERRORS: Array = np.stack((DOP853.E5, DOP853.E3))
_DENSE: Array = DOP853.D
SAFETY, SHRINK_MIN, GROWTH_MAX = 0.9, 0.2, 10.0
"""Of the next step: as scipy chooses it."""
STEP_S_MIN = 1e-9
STEPS_MAX = 100_000
"""In one call: more is a body that no truth could follow."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepControl:
    """Tolerances of a step, and which ones to try."""

    rtol: float
    atol: Array
    """One for each number."""
    first_s: float
    max_s: float


def integrate(
    derivative: Derivative, start: Array, times_s: Sequence[float], control: StepControl
) -> Array:
    """
    Return the numbers at some times.

    Args:
        derivative: Of M numbers.
        start: At time zero, shape (M,).
        times_s: K of them, s, ascending, above zero.
        control: Of the steps.

    Returns:
        Shape (K, M).

    Raises:
        ConfigurationError: No step passes.
    """
    out, known, end_s = np.empty((len(times_s), len(start))), 0, times_s[-1]
    step = _Step(derivative, start)
    h = control.first_s
    for _ in range(STEPS_MAX):
        h = min(h, control.max_s)
        is_last = step.t_s + h >= end_s
        if is_last:
            h = end_s - step.t_s
        size = step.attempt(h, control)
        factor = GROWTH_MAX if size == 0.0 else SAFETY * size**-0.125
        if not size < 1.0:
            h *= max(SHRINK_MIN, factor) if math.isfinite(size) else SHRINK_MIN
            if h < STEP_S_MIN:
                break
            continue
        until_s, first = end_s if is_last else step.t_s + h, known
        while known < len(times_s) and times_s[known] < until_s:
            known += 1
        if known > first:
            out[first:known] = step.between(np.array(times_s[first:known]))
        step.accept(until_s)
        if is_last:
            out[known:] = step.y
            return out
        h *= min(GROWTH_MAX, factor)
    raise ConfigurationError(f"attitude, DOP853: no step passes {step.t_s:g} s after its start")


class _Step:
    """One step after the other."""

    def __init__(self, derivative: Derivative, start: Array) -> None:
        self.t_s = 0.0
        self.y = start
        self._derivative = derivative
        self._stages = np.empty((STAGES + 4, len(start)))
        self._stages[0] = derivative(0.0, start.tolist())
        self._h = 0.0
        self._y_new = start

    def attempt(self, h: float, control: StepControl) -> float:
        """Try a step of *h* and return its error over what may be."""
        derivative, stages, y, t_s = self._derivative, self._stages, self.y, self.t_s
        for stage in range(1, STAGES):
            within = y + h * (_WEIGHTS[stage] @ stages[:stage])
            stages[stage] = derivative(t_s + _NODES[stage] * h, within.tolist())
        self._h, self._y_new = h, y + h * (_RESULT @ stages[:STAGES])
        stages[STAGES] = derivative(t_s + h, self._y_new.tolist())
        scale = control.atol + np.maximum(np.abs(y), np.abs(self._y_new)) * control.rtol
        errors = (_ERRORS @ stages[: STAGES + 1]) / scale
        fifth, third = float(errors[0] @ errors[0]), float(errors[1] @ errors[1])
        if fifth == 0.0 and third == 0.0:
            return 0.0
        return h * fifth / math.sqrt((fifth + 0.01 * third) * len(y))

    def between(self, times_s: Array) -> Array:
        """Return the numbers at times within the step that was tried, shape (K, M): of seventh order."""
        stages, h = self._stages, self._h
        for row, (weights, node) in enumerate(_EXTRA, start=STAGES + 1):
            within = self.y + h * (weights @ stages[:row])
            stages[row] = self._derivative(self.t_s + node * h, within.tolist())
        change = self._y_new - self.y
        terms = [
            change,
            h * stages[0] - change,
            2.0 * change - h * (stages[STAGES] + stages[0]),
            *(h * (_DENSE @ stages)),
        ]
        part = ((times_s - self.t_s) / h)[:, None]
        value = np.zeros((len(times_s), len(change)))
        for number, term in enumerate(reversed(terms)):
            value = (value + term) * (part if number % 2 == 0 else 1.0 - part)
        found: Array = self.y + value
        return found

    def accept(self, until_s: float) -> None:
        """Go to the end of the step that was tried."""
        self.t_s, self.y = until_s, self._y_new
        self._stages[0] = self._stages[STAGES]
