"""
Pacing of a fixed-rate loop on absolute deadlines, and the account of how well they were kept.

Pure: the caller brings the time, in seconds since simulated time zero (T0). A relative sleep adds up
its own lateness; deadlines counted from T0 cannot drift.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

from madns_runtime.errors import ConfigurationError, IllegalTransition

COUNT_ROUNDING = 1e-9
"""duration times rate this close to a whole number is that number: 0.7 s at 10 Hz are 7 ticks."""
TIME_EPSILON_S = 1e-9
GOLDEN_FRACTION = 0.6180339887498949


def count_ticks(duration_s: float, tick_hz: float) -> int:
    """
    Return how many ticks of *tick_hz* a run of *duration_s* has: one at 0 s, and all others before its end.

    A run that was stopped at its begin, of 0 s, has none. Neither 0.29 nor 0.7 is a float, so that a product is a little off: 0.29 * 100 is 28.999999999999996 and
    0.7 * 10 is 7.000000000000001. A share of a tick below COUNT_ROUNDING of the product is taken for such an error.
    """
    exact = duration_s * tick_hz
    nearest = round(exact)
    is_whole = abs(exact - nearest) <= COUNT_ROUNDING * max(1.0, exact)
    return max(int(duration_s > 0.0), nearest if is_whole else math.ceil(exact))


def last_period_s(duration_s: float, tick_hz: float) -> float:
    """
    Return when the periods of all ticks of a run of *duration_s* are over, s since T0: no tick is due later, whatever its phase.

    Where the duration is no whole number of periods that is behind it: at 0.25 Hz the third tick of 8.5 s is due at 8 s
    or, with a phase, up to 12 s.
    """
    return max(duration_s, count_ticks(duration_s, tick_hz) / tick_hz)


def has_tick_from(t_s: float, duration_s: float, tick_hz: float, phase_s: float = 0.0) -> bool:
    """
    Tell whether a run still has a tick for an agent that returns to it.

    Args:
        t_s: Simulated time of its return, s.
        duration_s: Of the run, s.
        tick_hz: Its rate, Hz.
        phase_s: Offset of its deadlines, s; in lockstep no agent has one.
    """
    last_s = (count_ticks(duration_s, tick_hz) - 1) / tick_hz + phase_s
    return t_s <= last_s + TIME_EPSILON_S


class TickTiming(NamedTuple):
    """One tick that is due now. A tuple, because one is made for every tick of every agent."""

    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody asks of a tick
    """Ticks since T0; skipped ones leave gaps."""
    t_s: float
    """Nominal simulated time, index / tick_hz: without phase, the same for every agent."""
    deadline_s: float
    """Time at which it should have begun: t_s plus the agent's phase."""
    lateness_s: float
    """Delay of its begin behind its deadline."""
    missed: int
    """Ticks skipped just before this one."""


class LatenessHistogram:
    """
    A running estimate of percentiles in bounded memory, for live display.

    Whole microseconds up to 31, then 16 buckets per octave: a percentile reads at most 1/16 too high.
    Exact statistics are made from the records.
    """

    VALUE_US_MAX = 2**36 - 1
    BUCKETS = 32 * 16 + 32

    __slots__ = ("_counts", "count", "max_us")

    def __init__(self) -> None:
        self._counts = [0] * self.BUCKETS
        self.count = 0
        self.max_us = 0

    def add(self, value_us: int) -> None:
        """Count one value, us; below zero counts as zero, beyond VALUE_US_MAX as that."""
        if value_us > self.max_us:
            value_us = self.max_us = min(value_us, self.VALUE_US_MAX)
        if value_us < 32:
            self._counts[max(value_us, 0)] += 1
        else:
            value_us = min(value_us, self.VALUE_US_MAX)
            shift = value_us.bit_length() - 5
            self._counts[(shift << 4) + (value_us >> shift)] += 1
        self.count += 1

    def percentile_us(self, percent: float) -> int:
        """Return the upper edge of the bucket that *percent* of all values reach, us; 0 without values."""
        wanted = math.ceil(self.count * percent / 100)
        seen = 0
        for bucket, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return min(self._upper_edge_us(bucket), self.max_us)
        return 0

    @staticmethod
    def _upper_edge_us(bucket: int) -> int:
        if bucket < 32:
            return bucket
        shift = (bucket >> 4) - 1
        return ((bucket - (shift << 4) + 1) << shift) - 1


class Pacer:
    """
    Tells which tick is due, and keeps the account of lateness, missed ticks and overruns.

    A tick that could not begin within one period of its deadline is missed: the newest due tick is
    run instead. For each tick call `begin`, run the step, call `end`.

    Args:
        tick_hz: Rate, Hz.
        phase_s: Offset of every deadline, within [0, 1 / tick_hz), s; see `staggered`.
        duration_s: Simulated time of the run: ticks with index / tick_hz below it are run, s.
        overrun_s: A step that ends this long after its period is an error, before that a warning, s.

    Raises:
        ConfigurationError: An argument is out of its range.
    """

    __slots__ = (
        "_closing_s",
        "_deadline_s",
        "_index",
        "_is_stepping",
        "_lateness",
        "_margin_s_min",
        "_phase_s",
        "_tick_hz",
        "_overrun_s",
        "missed",
        "not_run",
        "overrun_errors",
        "overrun_warnings",
        "run",
        "tick_count",
    )

    def __init__(
        self, *, tick_hz: float, phase_s: float, duration_s: float, overrun_s: float
    ) -> None:
        if not (0 < tick_hz < math.inf and 0 < duration_s < math.inf and overrun_s >= 0):
            raise ConfigurationError(
                "expected tick_hz > 0, duration_s > 0 and overrun_s >= 0, got"
                f" {tick_hz:g}, {duration_s:g} and {overrun_s:g}"
            )
        if not 0 <= phase_s * tick_hz < 1:
            raise ConfigurationError(f"expected 0 <= phase_s < 1 / {tick_hz:g}, got {phase_s:g}")
        self._tick_hz = tick_hz
        self._phase_s = phase_s
        self._overrun_s = overrun_s
        self.tick_count = count_ticks(duration_s, tick_hz)
        self.run = 0
        self.missed = 0
        self.not_run = 0
        self.overrun_warnings = 0
        self.overrun_errors = 0
        self._margin_s_min = math.inf
        self._lateness = LatenessHistogram()
        self._is_stepping = False
        self._move_to(0)

    @property
    def is_over(self) -> bool:
        """Whether no tick is left."""
        return self._index >= self.tick_count

    @property
    def next_index(self) -> int:
        """The tick to begin next; `tick_count` when none is left."""
        return self._index

    def next_deadline_s(self) -> float | None:
        """Return when the next tick is due, s since T0; None when none is left."""
        return self._deadline_s if self._index < self.tick_count else None

    def deadline_of(self, index: int) -> float:
        """Return when a tick is due, s since T0."""
        return index / self._tick_hz + self._phase_s

    def begin(self, now_s: float) -> TickTiming | None:
        """
        Begin the newest tick that is due at *now_s*; None if none is.

        None also means the end when the last ticks were all missed: `next_deadline_s` tells.

        Raises:
            IllegalTransition: The step before has not ended.
        """
        if self._is_stepping:
            raise IllegalTransition(f"tick {self._index - 1} has not ended: no other can begin")
        deadline_s = self._deadline_s
        if now_s < deadline_s:
            return None
        missed = 0
        if now_s >= self._closing_s:
            missed = self._skip(self._newest_due(now_s), "missed")
            if self._index >= self.tick_count:
                return None
            deadline_s = self._deadline_s
        index = self._index
        lateness_s = now_s - deadline_s
        self._lateness.add(int(lateness_s * 1e6))
        self.run += 1
        self._is_stepping = True
        self._move_to(index + 1)
        return TickTiming(index, index / self._tick_hz, deadline_s, lateness_s, missed)

    def end(self, now_s: float) -> float:
        """
        End the step that began last, and return its margin: time left until the next deadline, s.

        A negative margin is an overrun: a warning up to `overrun_s`, an error beyond (thesis
        A.2.5 warns from 0 and calls 5 ms an error).

        Raises:
            IllegalTransition: No step has begun.
        """
        if not self._is_stepping:
            raise IllegalTransition("no tick has begun: none can end")
        self._is_stepping = False
        margin_s = self._index / self._tick_hz + self._phase_s - now_s
        if margin_s < self._margin_s_min:
            self._margin_s_min = margin_s
        if margin_s < 0:
            if -margin_s <= self._overrun_s:
                self.overrun_warnings += 1
            else:
                self.overrun_errors += 1
        return margin_s

    def skip_to(self, now_s: float) -> int:
        """
        Go on with the first tick whose deadline has not passed, and return how many were passed over.

        For an agent that joins a run that is under way: those ticks were never its to run, so they
        count as `not_run`, not as missed.
        """
        due = self._newest_due(now_s)
        return self._skip(due if self.deadline_of(due) == now_s else due + 1, "not_run")

    def end_by(self, t_s: float) -> None:
        """Run no tick at simulated time *t_s* or later, s: the run ends there; an end that is later than its own changes nothing."""
        self.tick_count = min(self.tick_count, count_ticks(t_s, self._tick_hz))
        self._move_to(self._index)

    def finish(self, now_s: float) -> None:
        """Close the account at *now_s*: whatever was due until then and never run is missed."""
        self._is_stepping = False
        self._skip(self._newest_due(now_s) + 1, "missed")

    def summary(self) -> Mapping[str, int | None]:
        """
        Return the account so far.

        due = run + missed + not_run. Percentiles are estimates (see `LatenessHistogram`);
        margin_us_min is None until a step has ended.
        """
        has_margin = self._margin_s_min < math.inf
        return {
            "due": self.run + self.missed + self.not_run,
            "run": self.run,
            "missed": self.missed,
            "not_run": self.not_run,
            "overrun_warnings": self.overrun_warnings,
            "overrun_errors": self.overrun_errors,
            "lateness_us_p50": self._lateness.percentile_us(50),
            "lateness_us_p99": self._lateness.percentile_us(99),
            "lateness_us_max": self._lateness.max_us,
            "margin_us_min": round(self._margin_s_min * 1e6) if has_margin else None,
        }

    def _move_to(self, index: int) -> None:
        """Make *index* the next tick; when there is none, its deadline never comes."""
        self._index = index
        if index < self.tick_count:
            # Divided, not multiplied by a period or added up: tick 3 600 000 is as exact as tick 1.
            self._deadline_s = index / self._tick_hz + self._phase_s
            self._closing_s = (index + 1) / self._tick_hz + self._phase_s
        else:
            self._deadline_s = self._closing_s = math.inf

    def _newest_due(self, now_s: float) -> int:
        """Return the last index whose deadline is not after *now_s*: -1 before all, `tick_count` after the end."""
        if now_s >= self.deadline_of(self.tick_count):
            return self.tick_count
        index = max(math.floor((now_s - self._phase_s) * self._tick_hz), -1)
        # The product may be rounded across a whole number; the deadlines themselves decide.
        while self.deadline_of(index + 1) <= now_s:
            index += 1
        while index >= 0 and self.deadline_of(index) > now_s:
            index -= 1
        return index

    def _skip(self, index: int, account: Literal["missed", "not_run"]) -> int:
        skipped = min(index, self.tick_count) - self._index
        if skipped <= 0:
            return 0
        setattr(self, account, getattr(self, account) + skipped)
        self._move_to(self._index + skipped)
        return skipped


class RealTimeFactor:
    """Simulated seconds per second of a clock, over the span from the first tick to the last."""

    __slots__ = ("_first", "_last")

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None
        self._last = (0.0, 0.0)

    def add(self, t_s: float, now_s: float) -> None:
        """Note that simulated time *t_s* was reached at *now_s*."""
        self._last = (t_s, now_s)
        if self._first is None:
            self._first = self._last

    def value(self) -> float | None:
        """Return the factor; None until two ticks lie apart."""
        if self._first is None or self._last[1] <= self._first[1]:
            return None
        return (self._last[0] - self._first[0]) / (self._last[1] - self._first[1])


def staggered(
    count: int, tick_hz: float, *, phase: Literal["staggered", "aligned"] = "staggered"
) -> list[float]:
    """
    Return the phases of *count* agents, each in [0, 1 / tick_hz), s.

    They divide the period evenly, in the order of the golden section's multiples, so that the few agents of one
    machine, which are neighbours by index, are spread over the period as well. Aligned agents have none.
    """
    if phase == "aligned":
        return [0.0] * count
    ranked = sorted(range(count), key=lambda index: index * GOLDEN_FRACTION % 1.0)
    phases_s = [0.0] * count
    for rank, index in enumerate(ranked):
        phases_s[index] = rank / count / tick_hz
    return phases_s
