"""Statistics of every sample of a quantity, exact and in bounded memory. Pure numpy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.quantiles import quantile_of
from madns_runtime.analysis.values import Floats

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "p01": 0.01, "p001": 0.001}
SUMMARY_NAMES = ("count", "mean", "sd", "min", "max", "p50", "p99", "p999")


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Statistics of one quantity of one source."""

    count: int
    mean: float
    sd: float
    min: float
    max: float
    p50: float
    p99: float
    p999: float
    p01: float
    p001: float

    @property
    def range(self) -> float:
        """Largest minus smallest."""
        return self.max - self.min

    def to_mapping(self) -> dict[str, float]:
        """Return the statistics as run.json holds them."""
        return {name: rounded(getattr(self, name)) for name in (*SUMMARY_NAMES, "range")}

    def high(self) -> dict[str, float]:
        """Return p50, p99, p999 and max: of a quantity of which much is bad."""
        return {name: rounded(getattr(self, name)) for name in ("p50", "p99", "p999", "max")}

    def low(self) -> dict[str, float]:
        """Return p50, p01 (99 % have more), p001 and min: of a quantity of which little is bad."""
        return {name: rounded(getattr(self, name)) for name in ("p50", "p01", "p001", "min")}


class Distribution:
    """
    Every sample of a quantity, kept as the values that occur and how often each does.

    Exact, as if all samples were kept side by side; but whole microseconds of a day at 100 Hz of 93
    agents are a few thousand values and not six gigabytes.
    """

    def __init__(self) -> None:
        self._values: Floats = np.empty(0)
        self._counts: NDArray[np.int64] = np.empty(0, dtype=np.int64)

    @classmethod
    def of(cls, samples: NDArray[Any]) -> Distribution:
        """Return the distribution of samples, shape (N,); what is not finite is left out."""
        finite = samples if samples.dtype.kind in "iu" else samples[np.isfinite(samples)]
        values, counts = np.unique(finite, return_counts=True)
        made = cls()
        made._values, made._counts = values.astype(np.float64), counts
        return made

    def add(self, other: Distribution) -> None:
        """Take the samples of another distribution as well."""
        merged = np.concatenate((self._values, other._values))
        self._values, place = np.unique(merged, return_inverse=True)
        weights = np.concatenate((self._counts, other._counts))
        self._counts = np.bincount(place, weights, len(self._values)).astype(np.int64)

    def summary(self, scale: float = 1.0) -> Summary | None:
        """
        Return the statistics of all samples; None if there are none.

        Args:
            scale: Factor on the values, positive.
        """
        count = int(self._counts.sum())
        if not count:
            return None
        values = self._values * scale
        with np.errstate(over="ignore", invalid="ignore"):  # what diverged has no mean
            mean = float((values * self._counts).sum() / count)
            variance = float((self._counts * (values - mean) ** 2).sum() / count)
        cumulated = np.cumsum(self._counts)
        quantiles = {
            name: quantile_of(self._values, cumulated, share) * scale
            for name, share in QUANTILES.items()
        }
        return Summary(
            count=count,
            mean=mean,
            sd=math.sqrt(variance),
            min=float(values[0]),
            max=float(values[-1]),
            **quantiles,
        )


def summarise(samples: NDArray[Any]) -> Summary | None:
    """Return the statistics of all finite samples, shape (N,); None if there are none."""
    return Distribution.of(samples).summary()


def rounded(value: float) -> float:
    """Keep six significant figures of a statistic; counts stay whole."""
    return value if isinstance(value, int) else float(f"{value:.6g}")
