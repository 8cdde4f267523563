"""
DOP853 in machine code, one vehicle after another, each at its own steps. Pure.

Functions are compiled while this module is imported, which is in a job of the executor, and kept in
numba's cache beside this file or, where that is not writable, in the user's own cache folder. The
cache looks at this file alone: whatever comes from other modules is therefore an argument, never a
global, and no function is made by another, whose products would share one cache file.

Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section II.10; step
control and dense output as there and in scipy, whose coefficients the caller passes. Errors are
judged by the length of the error vectors against the length of position and velocity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import MissingExtraError

try:
    from numba import float64, int64, njit, types
except ImportError as error:
    raise MissingExtraError("numba", "fast") from error

Array = NDArray[np.float64]
Tables = tuple[Array, Array, Array, Array]
"""Model (8,), air (4, L), tableau (22, 16), limits (6,): see `numba_propagator`."""

MU, K2, K3, K4, RADIUS, FLATTENING, EARTH_RATE, R_MIN = range(8)
"""Of the model: mu; mu Jn R^n for n = 2, 3, 4, zero where not in force; radius; flattening; rate; where gravity ends to grow."""
RTOL, ATOL_M, STEP_S_MAX, FIRST_STEP_RAD, KINK_M_S, KINK_STEP_S_MIN = range(6)
"""Of the limits."""
STAGES = 12
ERROR_3, ERROR_5, DENSE = 16, 17, 18
"""Rows of the tableau after the stages, of which the last three serve dense output."""
VELOCITY_SHARE_PER_S = 1e-3
"""Absolute tolerance of velocity over that of position: about LEO's mean motion, 1/s."""
STEPS_MAX = 10_000_000
"""Steps of one vehicle in one call."""
STEP_S_MIN = 1e-9
"""A shorter step means that no step passes."""
DONE, STEP_TOO_SHORT, TOO_MANY_STEPS = range(3)
"""Result of a vehicle's integration."""

_VECTOR, _MATRIX = float64[::1], float64[:, ::1]
_TABLES = types.Tuple((_VECTOR, _MATRIX, _MATRIX, _VECTOR))
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
Function = TypeVar("Function", bound=Callable[..., object])


def compiled(signature: object) -> Callable[[Function], Function]:
    """Return what compiles a function now, for one signature, to run without Python's lock."""

    def compile_now(function: Function) -> Function:
        try:
            machine_code: Function = njit(signature, cache=True, **_OPTIONS)(function)
        except RuntimeError:
            # numba says so if no folder for its cache is writable: every process compiles for itself.
            machine_code = njit(signature, **_OPTIONS)(function)
        return machine_code

    return compile_now


@compiled(types.void(_VECTOR, _VECTOR, _VECTOR, _MATRIX, _VECTOR))
def derive(y: Array, dy: Array, model: Array, air: Array, vehicle: Array) -> None:
    """Put the derivative of a state (6,) into *dy*; vehicle is ballistic coefficient and thrust (4,)."""
    x, y_, z, vx, vy, vz = y
    r2 = max(x * x + y_ * y_ + z * z, model[R_MIN] * model[R_MIN])
    r = math.sqrt(r2)
    sine2 = z * z / r2
    inverse3 = 1.0 / (r2 * r)
    radial = -model[MU] * inverse3
    axial = 0.0
    if model[K2] != 0.0:
        scale = 1.5 * model[K2] * inverse3 / r2
        radial += scale * (5.0 * sine2 - 1.0)
        axial += 2.0 * scale * z
    if model[K3] != 0.0:
        scale = 0.5 * model[K3] * inverse3 / r2
        radial += scale * (35.0 * sine2 - 15.0) * z / r2
        axial += scale * (15.0 * sine2 - 3.0)
    if model[K4] != 0.0:
        scale = 0.125 * model[K4] * inverse3 / (r2 * r2)
        radial += scale * ((315.0 * sine2 - 210.0) * sine2 + 15.0)
        axial += scale * (140.0 * sine2 - 60.0) * z
    ax, ay, az = radial * x, radial * y_, radial * z - axial
    if vehicle[0] > 0.0:
        height = max(r - model[RADIUS] * (1.0 - model[FLATTENING] * sine2), 0.0)
        layer = np.searchsorted(air[0], height, side="right") - 1
        density = air[1, layer] * math.exp(-(height - air[0, layer]) / air[2, layer])
        wx, wy = vx + model[EARTH_RATE] * y_, vy - model[EARTH_RATE] * x
        scale = -0.5 * vehicle[0] * density * math.sqrt(wx * wx + wy * wy + vz * vz)
        ax += scale * wx
        ay += scale * wy
        az += scale * vz
    dy[0], dy[1], dy[2] = vx, vy, vz
    dy[3], dy[4], dy[5] = ax + vehicle[1], ay + vehicle[2], az + vehicle[3]


@compiled(types.void(_MATRIX, _MATRIX, float64, int64, _MATRIX))
def combine(y: Array, k: Array, h: float, row: int, tableau: Array) -> None:
    """Put y[0] + h * (row of the tableau) * k, of the stages before *row*, into y[1]; y is (2, 6)."""
    for c in range(6):
        total = 0.0
        for j in range(row):
            total += tableau[row, j] * k[j, c]
        y[1, c] = y[0, c] + h * total


@compiled(float64(_MATRIX, _MATRIX, float64, _MATRIX, _VECTOR))
def error_of(y: Array, k: Array, h: float, tableau: Array, limits: Array) -> float:
    """Return the error of the step from y[0] to y[1] over its tolerance."""
    third, fifth = 0.0, 0.0
    for half in range(2):
        size2 = 0.0
        third2, fifth2 = 0.0, 0.0
        for c in range(3 * half, 3 * half + 3):
            size2 += max(y[0, c] * y[0, c], y[1, c] * y[1, c])
            e3, e5 = 0.0, 0.0
            for j in range(STAGES + 1):
                e3 += tableau[ERROR_3, j] * k[j, c]
                e5 += tableau[ERROR_5, j] * k[j, c]
            third2 += e3 * e3
            fifth2 += e5 * e5
        atol = limits[ATOL_M] * (VELOCITY_SHARE_PER_S if half else 1.0)
        # As if each component had its share of the length.
        scale = atol + limits[RTOL] * math.sqrt(size2 / 3.0)
        third += third2 / (scale * scale)
        fifth += fifth2 / (scale * scale)
    if third == 0.0 and fifth == 0.0:
        return 0.0
    return h * fifth / math.sqrt((fifth + 0.01 * third) * 6.0)


@compiled(types.void(_MATRIX, _MATRIX, float64, _MATRIX, _MATRIX))
def prepare_dense(y: Array, k: Array, h: float, tableau: Array, dense: Array) -> None:
    """Put the interpolant's coefficients from y[0] to y[1], by all 16 stages, into *dense* (7, 6)."""
    for c in range(6):
        delta = y[1, c] - y[0, c]
        dense[0, c] = delta
        dense[1, c] = h * k[0, c] - delta
        dense[2, c] = 2.0 * delta - h * (k[STAGES, c] + k[0, c])
        for row in range(4):
            total = 0.0
            for j in range(16):
                total += tableau[DENSE + row, j] * k[j, c]
            dense[3 + row, c] = h * total


@compiled(float64(_MATRIX, _VECTOR, _MATRIX, _VECTOR, _VECTOR))
def step_limit_s(y: Array, model: Array, air: Array, vehicle: Array, limits: Array) -> float:
    """Return the longest step from y[0] that does not feel the kinks of the density: `atmosphere.kink_step_s`."""
    longest: float = limits[STEP_S_MAX]
    if not vehicle[0] > 0.0:
        return longest
    x, y_, z, vx, vy, vz = y[0]
    r2 = x * x + y_ * y_ + z * z
    r = math.sqrt(r2)
    climb = abs(x * vx + y_ * vy + z * vz) / r
    height = r - model[RADIUS] * (1.0 - model[FLATTENING] * z * z / r2)
    height = max(height - climb * longest, 0.0)
    layer = np.searchsorted(air[0], height, side="right") - 1
    density = air[1, layer] * math.exp(-(height - air[0, layer]) / air[2, layer])
    drag = 0.5 * vehicle[0] * density * (vx * vx + vy * vy + vz * vz)
    change: float = drag * climb * air[3, layer]
    if change * longest * longest <= 2.0 * limits[KINK_M_S]:
        return longest
    shortest: float = limits[KINK_STEP_S_MIN]
    return min(longest, max(shortest, math.sqrt(2.0 * limits[KINK_M_S] / change)))


@compiled(int64(_VECTOR, _VECTOR, _MATRIX, _VECTOR, _TABLES))
def integrate_one(
    state: Array, offsets_s: Array, out: Array, vehicle: Array, tables: Tables
) -> int:
    """Put the states at *offsets_s* (K,) after *state* into *out* (K, 6) and say how it went."""
    model, air, tableau, limits = tables
    y, k, dense = np.empty((2, 6)), np.empty((16, 6)), np.empty((7, 6))
    y[0] = state
    end_s, t_s, knot = offsets_s[-1], 0.0, 0
    while knot < len(offsets_s) and offsets_s[knot] <= 0.0:
        out[knot] = state
        knot += 1
    r2 = state[0] * state[0] + state[1] * state[1] + state[2] * state[2]
    h = limits[FIRST_STEP_RAD] * limits[RTOL] ** 0.125 * math.sqrt(r2**1.5 / model[MU])
    derive(y[0], k[0], model, air, vehicle)
    longest = step_limit_s(y, model, air, vehicle, limits)
    for _ in range(STEPS_MAX):
        if knot == len(offsets_s):
            return DONE
        left_s = end_s - t_s
        # Equal steps to the end, rather than a short last one.
        h = left_s / math.ceil(left_s / min(h, longest, left_s))
        for stage in range(1, STAGES + 1):
            combine(y, k, h, stage, tableau)
            derive(y[1], k[stage], model, air, vehicle)
        error = error_of(y, k, h, tableau, limits)
        if not error < 1.0:
            h *= max(0.2, 0.9 * error**-0.125) if error < math.inf else 0.2
            if not h > STEP_S_MIN:
                return STEP_TOO_SHORT
            continue
        is_last = h >= left_s
        until_s = end_s if is_last else t_s + h
        if offsets_s[knot] < until_s:
            # y[1] is used for the stages of dense output, and made anew by the row of its own stage.
            for stage in range(STAGES + 1, 16):
                combine(y, k, h, stage, tableau)
                derive(y[1], k[stage], model, air, vehicle)
            combine(y, k, h, STAGES, tableau)
            prepare_dense(y, k, h, tableau, dense)
        while knot < len(offsets_s) and offsets_s[knot] <= until_s:
            if offsets_s[knot] == until_s:
                out[knot] = y[1]
            else:
                x = (offsets_s[knot] - t_s) / h
                for c in range(6):
                    total = dense[6, c] * x
                    total = (total + dense[5, c]) * (1.0 - x)
                    total = (total + dense[4, c]) * x
                    total = (total + dense[3, c]) * (1.0 - x)
                    total = (total + dense[2, c]) * x
                    total = (total + dense[1, c]) * (1.0 - x)
                    out[knot, c] = (total + dense[0, c]) * x + y[0, c]
            knot += 1
        y[0] = y[1]
        k[0] = k[STAGES]
        t_s = until_s
        longest = step_limit_s(y, model, air, vehicle, limits)
        h *= min(10.0, 0.9 * error**-0.125) if error > 0.0 else 10.0
    return TOO_MANY_STEPS


@compiled(int64[::1](_MATRIX, _VECTOR, float64[:, :, ::1], _MATRIX, _TABLES))
def integrate(
    states: Array, offsets_s: Array, out: Array, vehicles: Array, tables: Tables
) -> NDArray[np.int64]:
    """
    Propagate vehicles one after another; frees Python's lock, so that threads share the work.

    Args:
        states: Shape (N, 6), m and m/s.
        offsets_s: Times after *states*, shape (K,), s, ascending, K > 0.
        out: Takes the states at them, shape (N, K, 6).
        vehicles: Ballistic coefficient, m^2/kg, and thrust, m/s^2, shape (N, 4).
        tables: See `Tables`.

    Returns:
        DONE or why not, of each vehicle, shape (N,).
    """
    outcomes = np.empty(len(states), np.int64)
    for n in range(len(states)):
        outcomes[n] = integrate_one(states[n], offsets_s, out[n], vehicles[n], tables)
    return outcomes
