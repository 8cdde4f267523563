"""Samples of a device at rest: their mean, how sure it is, and whether it did rest. Pure."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from madns_runtime.hardware.calibration.result import (
    AXES,
    SI_UNITS,
    ChannelSamples,
    Estimate,
    Floats,
    SensorCalibration,
    SensorName,
)
from madns_runtime.hardware.units import factor_of

SAMPLES_MIN: Final = 20
PARTS: Final = 8
"""Parts of the time whose means are compared."""
MOVED: Final[dict[SensorName, float]] = {
    "gyro": math.radians(0.2),
    "accelerometer": 0.1,
    "magnetometer": 1e-6,
}
"""Differences between parts, rad/s, m/s^2 and T, that no sensor at rest shows; below, noise may be all of it."""
MOVED_SIGMAS: Final = 6.0


def rest_bias(samples: ChannelSamples) -> SensorCalibration:
    """Return a gyroscope's bias from what it gave at rest; the Earth's own turning (15 deg/h) is in it."""
    remarks = [*rest_faults(samples, "gyro")]
    is_usable = not remarks
    mean, sigma = mean_at_rest(samples) if len(samples.t_s) else (np.zeros(3), np.zeros(3))
    if is_usable:
        still = [
            axis
            for axis, spread in zip(AXES, np.ptp(samples.values, axis=0), strict=True)
            if not spread
        ]
        if still:
            remarks.append(f"{', '.join(still)}: not one digit changed: coarse, or frozen")
    residual = float(np.sqrt(np.mean((samples.values - mean) ** 2))) if len(samples.t_s) else None
    return SensorCalibration(
        sensor="gyro",
        channel=samples.name,
        unit=samples.unit,
        samples=len(samples.t_s),
        is_usable=is_usable,
        remarks=tuple(remarks),
        bias=Estimate(values=tuple(mean.tolist()), sigmas=tuple(sigma.tolist())),
        residual=residual,
    )


def rest_faults(samples: ChannelSamples, sensor: SensorName, where: str = "") -> list[str]:
    """Return why samples are none of a device at rest; nothing if they may be."""
    place = f"{where}: " if where else ""
    count = len(samples.t_s)
    if count < SAMPLES_MIN:
        return [f"{place}expected at least {SAMPLES_MIN} samples, got {count}: record for longer"]
    faults = [f"{place}{text}" for text in clipping(samples, is_at_rest=True)]
    # Differences of neighbours know nothing of slow movement.
    noise = np.std(np.diff(samples.values, axis=0), axis=0) / math.sqrt(2.0)
    means = np.array([part.mean(axis=0) for part in _parts(samples.values)])
    limit = MOVED_SIGMAS * noise * math.sqrt(PARTS / count)
    limit += MOVED[sensor] / (factor_of(samples.unit, SI_UNITS[sensor]) or 1.0)
    spread = np.ptp(means, axis=0)
    worst = int(np.argmax(spread / limit))
    if spread[worst] > limit[worst]:
        faults.append(
            f"{place}it moved while it should rest: the mean of {AXES[worst]} went by {spread[worst]:.3g} "
            f"{samples.unit}, expected less than {limit[worst]:.3g}"
        )
    return faults


def mean_at_rest(samples: ChannelSamples) -> tuple[Floats, Floats]:
    """Return the mean and its standard deviation: the larger of what samples, and what parts of the time tell."""
    values = samples.values
    mean = values.mean(axis=0)
    white = values.std(axis=0, ddof=1) / math.sqrt(len(values)) if len(values) > 1 else mean * 0.0
    if len(values) < PARTS:
        return mean, white
    means = np.array([part.mean(axis=0) for part in _parts(values)])
    return mean, np.maximum(white, means.std(axis=0, ddof=1) / math.sqrt(PARTS))


EXTREMES_MIN: Final = 5
EXTREMES_SHARE: Final = 0.02
EXTREMES_RATIO: Final = 5.0
"""An extreme value that comes at least so often, in such a share of samples, and so many times as often as the value
next to it is a limit and no measurement."""


def clipping(samples: ChannelSamples, *, is_at_rest: bool) -> list[str]:
    """
    Return a sentence per axis that met a limit: the channel's own, or one that shows in its values.

    Args:
        samples: What it gave.
        is_at_rest: Whether it rested: noise of few digits has extremes that come often.
    """
    found = []
    levels_min = 2 * EXTREMES_MIN if is_at_rest else 2
    for axis, values in zip(AXES, samples.values.T, strict=True):
        if samples.limits is not None:
            low, high = samples.limits
            count = int(np.count_nonzero((values <= low) | (values >= high)))
            if count:
                found.append(
                    f"{axis}: clipped: {count} of {len(values)} samples are at a limit of the channel ({low:g}, {high:g})"
                )
                continue
        if (worst := _repeated_extreme(values, levels_min)) is not None:
            found.append(
                f"{axis}: clipped: {worst[1]} of {len(values)} samples are {worst[0]:g} and none is beyond"
            )
    return found


def _repeated_extreme(values: Floats, levels_min: int) -> tuple[float, int] | None:
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < levels_min:
        return None
    for extreme, beside in ((0, 1), (-1, -2)):
        count = int(counts[extreme])
        if count >= max(
            EXTREMES_MIN, EXTREMES_SHARE * len(values), EXTREMES_RATIO * counts[beside]
        ):
            return float(levels[extreme]), count
    return None


def _parts(values: Floats) -> list[Floats]:
    return np.array_split(values, PARTS)
