"""
Flight software's own rate against that of the ticks: how many of its steps a tick has, or how many ticks a step. Pure.

On neither side of the wall: `cosmos validate` asks here as well as the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

STEPS_PER_TICK_MAX = 50
"""Steps of flight software in one tick: more of them want a faster tick."""
TICKS_PER_STEP_MAX = 100_000
RATIO_TOLERANCE = 1e-9
"""Of a ratio of rates from a whole number: of what is written in decimals."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRate:
    """Steps of flight software: several in a tick, or one in several ticks."""

    hz: float
    steps_per_tick: int = 1
    ticks_per_step: int = 1

    def early_times_s(self, tick: int) -> list[float]:
        """Return the times of the steps after the tick before and before a tick's own."""
        last = tick * self.steps_per_tick
        return [step / self.hz for step in range(last - self.steps_per_tick + 1, last)]


def flight_rate(rate_hz: float | None, tick_hz: float) -> FlightRate:
    """
    Return how flight software's steps lie among the ticks.

    Args:
        rate_hz: Its own; None for that of the ticks.
        tick_hz: Of the ticks.

    Raises:
        ValueError: Neither rate is a whole multiple of the other, or one is too many times the other.
    """
    if rate_hz is None:
        return FlightRate(hz=tick_hz)
    is_faster = rate_hz >= tick_hz
    ratio = rate_hz / tick_hz if is_faster else tick_hz / rate_hz
    most = STEPS_PER_TICK_MAX if is_faster else TICKS_PER_STEP_MAX
    if ratio > most + 0.5:  # of a rate that is next to nothing it may be infinite
        few = (
            f"at most {most} times agents.tick_hz"
            if is_faster
            else f"one step in at most {most} ticks"
        )
        raise ValueError(f"expected {few}, {tick_hz:g} Hz, got {rate_hz:g}")
    whole = round(ratio)
    if abs(ratio - whole) > RATIO_TOLERANCE * ratio:
        raise ValueError(
            f"expected a rate that divides agents.tick_hz, {tick_hz:g} Hz, or is a whole multiple of it, got {rate_hz:g}"
        )
    if is_faster:
        return FlightRate(hz=rate_hz, steps_per_tick=whole)
    return FlightRate(hz=rate_hz, ticks_per_step=whole)
