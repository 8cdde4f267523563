"""
What the two halves of the constellation say to each other, as dataclasses that become mappings.

Pure. Segments carry their knots as one flat float64 array: six numbers a knot, m and m/s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import PluginError
from madns_runtime.simulations.constellation.parameters import KNOTS_MAX

SEGMENT = "segment"


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A stretch of one vehicle's future truth."""

    revision: int
    """Grows with every maneuver; a newer one replaces the future from its first knot on."""
    t0_s: float
    """Simulated time of the first knot, s."""
    knot_s: float
    """Time between knots, s."""
    states: NDArray[np.float64]
    """Shape (K, 6), m and m/s, K >= 2."""

    @property
    def end_s(self) -> float:
        """Simulated time of the last knot."""
        return self.t0_s + (len(self.states) - 1) * self.knot_s

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {
            "kind": SEGMENT,
            "revision": self.revision,
            "t0_s": self.t0_s,
            "knot_s": self.knot_s,
            "states": np.ascontiguousarray(self.states, dtype=np.float64).ravel(),
        }

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Segment:
        """
        Read a segment back.

        Raises:
            PluginError: It is not a segment as `to_message` writes it.
        """
        try:
            flat = np.asarray(message["states"], dtype=np.float64).ravel()
            segment = cls(
                revision=int(message["revision"]),
                t0_s=float(message["t0_s"]),
                knot_s=float(message["knot_s"]),
                states=flat.reshape(-1, 6),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(f"constellation: expected a segment, got {message!r:.200}") from error
        finite = np.isfinite(flat).all() and np.isfinite((segment.t0_s, segment.knot_s)).all()
        if not finite or segment.knot_s <= 0.0 or not 2 <= len(segment.states) <= KNOTS_MAX:
            raise PluginError(
                f"constellation: expected a segment of 2 to {KNOTS_MAX} finite knots, got "
                f"{len(segment.states)} every {segment.knot_s} s"
            )
        return segment


@dataclass(frozen=True, slots=True, kw_only=True)
class Initial:
    """What an agent sets itself up from, at the start or when it rejoins."""

    satellite: str
    frame: str
    epoch_utc: str
    """UTC of simulated time zero, ISO 8601."""
    segment: Segment | None
    """Truth from now on; None if the host itself has none yet."""

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {
            "satellite": self.satellite,
            "frame": self.frame,
            "epoch_utc": self.epoch_utc,
            "segment": None if self.segment is None else self.segment.to_message(),
        }

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Initial:
        """
        Read initial data back.

        Raises:
            PluginError: They are not as `to_message` writes them.
        """
        try:
            segment = message["segment"]
            return cls(
                satellite=str(message["satellite"]),
                frame=str(message["frame"]),
                epoch_utc=str(message["epoch_utc"]),
                segment=None if segment is None else Segment.from_message(segment),
            )
        except (KeyError, TypeError) as error:
            raise PluginError(
                f"constellation: expected initial data, got {message!r:.200}"
            ) from error
