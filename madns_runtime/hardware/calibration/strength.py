"""Calibration against a strength that does not depend on how a sensor lies: gravity, and the Earth's field. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from madns_runtime.hardware.calibration.ellipsoid import EllipsoidFit, fit_ellipsoid, plane_of
from madns_runtime.hardware.calibration.rest import clipping, mean_at_rest, rest_faults
from madns_runtime.hardware.calibration.result import (
    AXES,
    SI_UNITS,
    ChannelSamples,
    Estimate,
    Floats,
    SensorCalibration,
    SensorName,
)
from madns_runtime.hardware.units import G0_M_S2, factor_of

UPRIGHT_MIN: Final = 0.7
"""Change of an axis over all positions as a share of the largest one's; half of it is upright one way only."""
SEEN_MIN: Final = 0.5
"""Share of the field that an axis must have had along it, and against it."""
SAMPLES_MIN: Final = 50
FULL_SAMPLES_MIN: Final = 100
FULL_GAIN_MIN: Final = 20.0
"""F statistic from which three numbers more are worth it: leaking between axes, not noise."""
UNCERTAIN_SHARE: Final = 0.05
"""Standard deviation of a scale, or of a bias as a share of the strength, that is no calibration any more."""
LEFT_SHARE: Final = 0.1
"""Share of the strength that may remain: more means iron, currents or movement nearby."""


def calibrate_positions(positions: Sequence[ChannelSamples]) -> SensorCalibration:
    """Return an accelerometer's scale and bias from what it gave at rest with each axis up and down: six positions or more."""
    first = positions[0]
    strength = G0_M_S2 / _factor(first, "accelerometer")
    remarks = [
        fault
        for number, samples in enumerate(positions, start=1)
        for fault in rest_faults(samples, "accelerometer", f"position {number}")
    ]
    total = sum(len(samples.t_s) for samples in positions)
    if any(len(samples.t_s) == 0 for samples in positions):
        return _useless("accelerometer", first, total, remarks)
    means, sigmas = map(np.array, zip(*map(mean_at_rest, positions), strict=True))
    remarks += _positions_missing(means)
    fit = None
    if not remarks:
        sigma = float(np.sqrt(np.mean(sigmas**2)))
        fit = fit_ellipsoid(means, strength, is_full=False, sigma=_sigma_of(means, strength, sigma))
        if fit is None:
            remarks.append(
                "the positions tell no scale: expected six, each axis once up and once down"
            )
    if fit is None:
        return _useless("accelerometer", first, total, remarks)
    return _result("accelerometer", first, fit, (total, strength), remarks)


def calibrate_turned(samples: ChannelSamples, strength_t: float | None) -> SensorCalibration:
    """
    Return a magnetometer's hard iron and scale, or soft iron, from what it gave while it was turned to all sides.

    Args:
        samples: What it gave.
        strength_t: The field's, T; None if nobody knows: the scale then tells no more than how axes differ.
    """
    remarks = clipping(samples, is_at_rest=False)
    if len(samples.t_s) < SAMPLES_MIN:
        remarks.append(f"expected at least {SAMPLES_MIN} samples, got {len(samples.t_s)}")
    elif (normal := plane_of(samples.values)) is not None:
        axis = AXES[int(np.argmax(np.abs(normal)))]
        x, y, z = normal
        remarks.append(
            f"what it gave lies in a plane across ({x:.2f}, {y:.2f}, {z:.2f}): it was turned about one axis, about"
            f" {axis}; turn it about the others, too"
        )
    if remarks:
        return _useless("magnetometer", samples, len(samples.t_s), remarks)
    given = None if strength_t is None else strength_t / _factor(samples, "magnetometer")
    strength = given or float(np.sqrt(3.0 * np.mean(np.var(samples.values, axis=0))))
    fit = _best(samples.values, strength)
    if fit is None:
        remarks.append(
            "what it gave lies on no ellipsoid: turn it slowly to all sides, away from iron"
        )
        return _useless("magnetometer", samples, len(samples.t_s), remarks)
    remarks += _sides_missing(fit.directions(samples.values))
    if given is None:
        fit = _at_unit_scale(fit)
        note = "the field's strength is unknown: axes are made equal, and the scale as a whole is not calibrated"
        return _result("magnetometer", samples, fit, (len(samples.t_s), None), remarks, note)
    return _result("magnetometer", samples, fit, (len(samples.t_s), strength), remarks)


def _best(values: Floats, strength: float) -> EllipsoidFit | None:
    """Return the fit along the axes, or the full one where that explains more than chance does."""
    plain = fit_ellipsoid(values, strength, is_full=False)
    full = fit_ellipsoid(values, strength, is_full=True)
    if full is None or len(values) < FULL_SAMPLES_MIN or _is_uncertain(full, strength):
        return plain
    if plain is None:
        return full
    spare = len(values) - full.parameters
    gain = (plain.squares - full.squares) / 3.0
    is_better = gain > FULL_GAIN_MIN * full.squares / spare and plain.squares > 1.1 * full.squares
    return full if is_better else plain


def _at_unit_scale(fit: EllipsoidFit) -> EllipsoidFit:
    """Return a fit whose shape has the determinant 1."""
    size = float(np.linalg.det(fit.shape)) ** (1.0 / 3.0)
    return EllipsoidFit(
        shape=fit.shape / size,
        shape_sigmas=fit.shape_sigmas / size,
        offset=fit.offset / size,
        offset_sigmas=fit.offset_sigmas / size,
        residuals=fit.residuals / size,
        parameters=fit.parameters,
    )


def _result(
    sensor: SensorName,
    samples: ChannelSamples,
    fit: EllipsoidFit,
    of: tuple[int, float | None],
    remarks: list[str],
    *notes: str,
) -> SensorCalibration:
    count, strength = of
    size = strength or float(
        np.mean(np.linalg.norm(samples.values @ fit.shape.T - fit.offset, axis=1))
    )
    left = float(np.sqrt(np.mean(fit.residuals**2)))
    if _is_uncertain(fit, size):
        remarks = [
            *remarks,
            f"too uncertain: a standard deviation is above {100 * UNCERTAIN_SHARE:g} % of the strength",
        ]
    if left > LEFT_SHARE * size:
        remarks = [
            *remarks,
            f"the strength differs by {100 * left / size:.0f} % (rms) however it lies: iron or currents nearby, or it was"
            " shaken",
        ]
    is_full = bool(np.any(fit.shape != np.diag(np.diag(fit.shape))))
    bias, bias_sigmas = fit.offset, fit.offset_sigmas
    if is_full:  # the bias is taken off before the matrix
        inverse = np.linalg.inv(fit.shape)
        bias, bias_sigmas = inverse @ fit.offset, np.abs(inverse) @ fit.offset_sigmas
    return SensorCalibration(
        sensor=sensor,
        channel=samples.name,
        unit=samples.unit,
        samples=count,
        is_usable=not remarks,
        remarks=(*remarks, *notes),
        bias=_estimate(bias, bias_sigmas),
        scale=None if is_full else _estimate(np.diag(fit.shape), np.diag(fit.shape_sigmas)),
        alignment=_rows(fit.shape) if is_full else None,
        alignment_sigmas=_rows(fit.shape_sigmas) if is_full else None,
        residual=left,
        strength=strength,
    )


def _useless(
    sensor: SensorName, samples: ChannelSamples, count: int, remarks: list[str]
) -> SensorCalibration:
    return SensorCalibration(
        sensor=sensor,
        channel=samples.name,
        unit=samples.unit,
        samples=count,
        is_usable=False,
        remarks=tuple(remarks),
    )


def _is_uncertain(fit: EllipsoidFit, strength: float) -> bool:
    sigmas = [*np.diag(fit.shape_sigmas) / np.diag(fit.shape), *fit.offset_sigmas / strength]
    return not max(sigmas) < UNCERTAIN_SHARE


def _sigma_of(means: Floats, strength: float, sigma: float) -> float:
    """Return the standard deviation of strengths from that of raw values: a scale lies between."""
    spread = float(np.sqrt(np.mean(np.var(means, axis=0))))
    return max(sigma, 1e-12 * spread) * strength / (spread * math.sqrt(3.0))


def _positions_missing(means: Floats) -> list[str]:
    """Return which axes have not stood upright both ways: what they gave went less far than the farthest did."""
    width = np.ptp(means, axis=0)
    # Where all positions are one, differences are noise: gravity itself is the measure then.
    widest = max(float(width.max()), float(np.median(np.linalg.norm(means, axis=1))))
    if not widest > 0.0:
        return ["it gave nothing but zeros"]
    return [
        f"{axis} did not stand upright both ways: not observable; add positions with {axis} up and with {axis} down"
        for axis, share in zip(AXES, width / widest, strict=True)
        if share < UPRIGHT_MIN
    ]


def _sides_missing(directions: Floats) -> list[str]:
    return [
        f"{axis}: it saw {along.min():+.2f} to {along.max():+.2f} of the field: not observable, expected"
        f" {-SEEN_MIN:+g} to {SEEN_MIN:+g} at least; turn {axis} along the field and against it"
        for axis, along in zip(AXES, directions.T, strict=True)
        if along.max() < SEEN_MIN or along.min() > -SEEN_MIN
    ]


def _factor(samples: ChannelSamples, sensor: SensorName) -> float:
    return factor_of(samples.unit, SI_UNITS[sensor]) or 1.0


def _estimate(values: Floats, sigmas: Floats) -> Estimate:
    return Estimate(values=tuple(values.tolist()), sigmas=tuple(sigmas.tolist()))


def _rows(matrix: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())
