"""Results of a calibration: numbers, their uncertainty, and what could not be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SensorName = Literal["gyro", "accelerometer", "magnetometer"]
SI_UNITS: Final[dict[SensorName, str]] = {
    "gyro": "rad/s",
    "accelerometer": "m/s^2",
    "magnetometer": "T",
}
AXES: Final = ("x", "y", "z")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelSamples:
    """Samples that one channel of three numbers gave in one go."""

    name: str
    """The channel's."""
    unit: str
    t_s: Floats
    """When it was taken, s; shape (N,)."""
    values: Floats
    """Shape (N, 3)."""
    limits: tuple[float, float] | None = None
    """Least and largest value that the channel can give; None where they are not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Three numbers, one per axis, with their standard deviations."""

    values: tuple[float, ...]
    sigmas: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorCalibration:
    """Result of one sensor's calibration: a reading is alignment (scale raw - bias)."""

    sensor: SensorName
    channel: str
    unit: str
    """Of bias and residual: the channel's."""
    samples: int
    is_usable: bool
    """Whether the numbers may be used; else `remarks` tell why not."""
    remarks: tuple[str, ...] = ()
    bias: Estimate | None = None
    scale: Estimate | None = None
    """None: 1."""
    alignment: tuple[tuple[float, ...], ...] | None = None
    """Symmetric: scale and leaking between axes at once; None: none."""
    alignment_sigmas: tuple[tuple[float, ...], ...] | None = None
    residual: float | None = None
    """Root mean square of what the numbers leave of the strength's differences."""
    strength: float | None = None
    """Gravity or field that the scale was made for, in the channel's unit; None where nobody said."""

    def settings(self) -> dict[str, Any]:
        """Return what stands in a scenario for it, without the device; nothing if it may not be used."""
        if not self.is_usable:
            return {}
        told: dict[str, Any] = {}
        if self.alignment is not None:
            told["alignment"] = [list(map(_shown, row)) for row in self.alignment]
        if self.scale is not None:
            told["scale"] = list(map(_shown, self.scale.values))
        if self.bias is not None:
            told["bias"] = list(map(_shown, self.bias.values))
        return told


def _shown(number: float) -> float:
    """Return a number with the digits that any sensor has."""
    return float(f"{number:.7g}")
