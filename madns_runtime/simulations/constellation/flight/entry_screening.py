"""
Screening of what members of a ring tell of each other: whoever lies, or is broken, must not move the others.

Two screens. An entry that continues an older one of the same member must lie where the member's own rate and burns
can have taken it; any other is refused, and the older one is carried on in its place. And the ring's average is
taken of the members near the median alone. A lie that is told from the first word on about many members
passes the first screen, and the second where it is about fewer than half of them. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rounds = NDArray[np.int64]
Flags = NDArray[np.bool_]

JUMP_RAD = math.radians(0.1)
"""Between a member's entry and where the one before it leads; mean elements are off by a hundredth of that."""
SMA_CHANGE_M = 4000.0
"""Between two entries of a member: two burns of 1 m/s, the largest that slot keeping commands."""
SPREADS = 5.0
"""Robust standard deviations from the median, within which a member counts."""
SPREAD_PER_MAD = 1.4826
"""Standard deviation of a normal distribution over the median of absolute deviations."""
SPREAD_RAD_MIN = math.radians(0.1)
SPREAD_M_MIN = 100.0
"""Spreads below these are those of the noise of mean elements: nobody is cut off for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EntryGate:
    """Plausibility of an entry that follows another of the same member."""

    drift_rad_s_m: float
    """Rate per metre of semi-major axis above the design orbit's."""
    exchange_s: float

    def accepts(
        self, *, phases_rad: tuple[Floats, Floats], smas_m: tuple[Floats, Floats], rounds: Rounds
    ) -> Flags:
        """
        Return which entries can be, shape (K,).

        Args:
            phases_rad: Before and now.
            smas_m: Semi-major axes above the design orbit's, before and now.
            rounds: From the one to the other.
        """
        (phase_before, phase_now), (sma_before, sma_now) = phases_rad, smas_m
        passed_s = rounds * self.exchange_s
        change_m = np.abs(sma_now - sma_before)
        led_rad = phase_before + self.drift_rad_s_m * 0.5 * (sma_before + sma_now) * passed_s
        # Nobody knows when in between it burnt.
        unsure_rad = 0.5 * np.abs(self.drift_rad_s_m) * change_m * passed_s
        off_rad = np.abs((phase_now - led_rad + math.pi) % math.tau - math.pi)
        accepted: Flags = (off_rad <= JUMP_RAD + unsure_rad) & (change_m <= SMA_CHANGE_M)
        return accepted


def near_median(values: Floats, spread_min: float) -> Flags:
    """Return which values are within some robust standard deviations of their median, shape (K,)."""
    off = np.abs(values - np.median(values))
    spread = max(SPREAD_PER_MAD * float(np.median(off)), spread_min)
    near: Flags = off <= SPREADS * spread
    return near
