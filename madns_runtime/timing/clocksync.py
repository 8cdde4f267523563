"""
An agent's estimate of the host's monotonic clock: offset, drift and how far both can be wrong.

Pure: it is given exchanges of four timestamps and never reads a clock. Of every slot of time the
exchange with the shortest round trip is kept (queues only ever lengthen one), a weighted line through
those gives offset and drift, and the uncertainty is built from bounds that hold whatever the queues
did: the true offset lies within half a round trip of an exchange's own.

The line that is served to callers follows the estimated one without a jump: it is corrected by
slewing, so that host time as an agent sees it never runs backwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from madns_runtime.errors import PeerError

EXCHANGES_MIN = 3
"""An estimate is valid from here on: the first exchanges meet cold caches."""
SLOTS_MAX = 32
SLOT_S_FIRST = 0.25
SLOT_S_MAX = 2.0
"""Slots double in length as the window fills, up to a window of 64 s: drift of crystals moves in minutes."""
DRIFT_MAX = 700e-6
"""Two free crystals differ by less than 200 ppm, and a time service slews the monotonic clock too, by up to 500 ppm."""
DRIFT_PRIOR = 100e-6
"""Standard deviation of the drift before anything is known."""
DRIFT_WANDER = 1e-6
"""Distance that drift may have moved since the newest exchange."""
STAMP_NOISE_S = 5e-6
"""Between reading the clock and the system call lies some of the interpreter."""
STEP_UNCERTAINTIES = 2.0
STEP_CONFIRMATIONS = 2
"""So many exchanges in a row that contradict the estimate by more than this many uncertainties are a step."""
SLEW_S = 1.0
"""A correction is spread over this long..."""
SLEW_MIN = 500e-6
SLEW_MAX = 0.5
"""...but never at a rate below or above these (seconds per second): below 1, time goes on."""
QUERY_AHEAD_S_MAX = 1.0


class _Sample(NamedTuple):
    """One exchange, reduced."""

    local_s: float
    """Local time half-way through."""
    offset_s: float
    """Host minus local, if both ways took as long."""
    round_trip_s: float
    """Without the host's own time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """Offset as a line over local time, with bounds of its error."""

    centre_s: float
    offset_s: float
    drift: float
    offset_error_s: float
    drift_error: float
    newest_s: float

    def at(self, local_s: float) -> float:
        return self.offset_s + (local_s - self.centre_s) * self.drift

    def error_at(self, local_s: float) -> float:
        age_s = max(0.0, local_s - self.newest_s)
        return (
            self.offset_error_s
            + abs(local_s - self.centre_s) * self.drift_error
            + age_s * DRIFT_WANDER
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Served:
    """
    The continuous line that callers see.

    For *slewing_s* it runs at 1 + drift + slew, from there on it is the estimated line.
    """

    anchor_s: float
    offset_s: float
    drift: float
    slew: float
    slewing_s: float

    @property
    def until_s(self) -> float:
        """Return the local time at which it meets the estimated line."""
        return self.anchor_s + self.slewing_s

    def offset_at(self, local_s: float) -> float:
        since_s = local_s - self.anchor_s
        slewing_s = min(max(since_s, 0.0), self.slewing_s)
        return self.offset_s + since_s * self.drift + slewing_s * self.slew

    def correction_left_s(self, local_s: float) -> float:
        left_s = self.until_s - max(local_s, self.anchor_s)
        return abs(self.slew) * left_s if left_s > 0 else 0.0

    def local_at(self, host_s: float) -> float:
        """Return the local time at which the served host time is *host_s*."""
        # Differences first: host and local time may be large and nearly equal.
        ahead_s = host_s - self.anchor_s - self.offset_s
        if ahead_s <= 0:
            return self.anchor_s + ahead_s / (1 + self.drift)
        slewing_s = self.slewing_s
        slewed_host_s = slewing_s * (1 + self.drift + self.slew)
        if ahead_s <= slewed_host_s:
            return self.anchor_s + ahead_s / (1 + self.drift + self.slew)
        return self.until_s + (ahead_s - slewed_host_s) / (1 + self.drift)


class ClockEstimate:
    """
    The host's clock as seen from here.

    Bounded: at most SLOTS_MAX exchanges are kept. `to_host_s` is continuous and rising from the
    moment `is_valid` is true: a new estimate is approached at SLEW_MIN to SLEW_MAX seconds per
    second, so host time runs slower for a while rather than back. Only a step of the host's clock
    forwards, once it is confirmed, is followed at once. What is still to be slewed is part of the
    uncertainty.
    """

    def __init__(self) -> None:
        self._samples: list[_Sample] = []
        self._slot_s = SLOT_S_FIRST
        self._slot_began_s = -math.inf
        self._suspects: list[_Sample] = []
        self._line: _Line | None = None
        self._served: _Served | None = None
        self._asked_s = -math.inf
        self._is_settled = False
        self.exchanges = 0
        """Exchanges accepted."""
        self.rejected = 0
        """Exchanges whose timestamps cannot be: cause after effect, or not finite."""
        self.steps = 0
        """Steps of either clock that were detected."""
        self.changes = 0
        """How often what is served has changed: between two changes a time of one clock is the same of the other."""

    @property
    def is_valid(self) -> bool:
        """Whether enough exchanges came to rely on the estimate."""
        return self.exchanges >= EXCHANGES_MIN

    @property
    def drift_ppm(self) -> float:
        """Drift of the host's clock against this one, 1e-6, positive if it is faster; 0 before the first exchange."""
        return self._line.drift * 1e6 if self._line else 0.0

    @property
    def round_trip_s_min(self) -> float:
        """Shortest round trip in the window, s; infinite before the first exchange."""
        return min((sample.round_trip_s for sample in self._samples), default=math.inf)

    def add_exchange(
        self,
        t_sent_s: float,
        t_peer_received_s: float,
        t_peer_sent_s: float,
        t_received_s: float,
    ) -> bool:
        """
        Take in one exchange; False if it was rejected.

        Args:
            t_sent_s: Local clock, when the question left.
            t_peer_received_s: Host's clock, when it came there.
            t_peer_sent_s: Host's clock, when the answer left.
            t_received_s: Local clock, when it came here.
        """
        there_s = t_peer_received_s - t_sent_s
        back_s = t_peer_sent_s - t_received_s
        round_trip_s = there_s - back_s
        is_causal = t_received_s >= t_sent_s and t_peer_sent_s >= t_peer_received_s
        if not (is_causal and 0 <= round_trip_s < math.inf):
            self.rejected += 1
            return False
        self.exchanges += 1
        sample = _Sample((t_sent_s + t_received_s) / 2, (there_s + back_s) / 2, round_trip_s)
        self._take(sample, t_received_s)
        return True

    def offset_s(self, at_local_s: float) -> float:
        """
        Return host minus local clock as served at a local time, s.

        Raises:
            PeerError: No exchange has come yet.
        """
        return self._known().offset_at(at_local_s)

    def rate(self, at_local_s: float, span_s: float) -> float:
        """Return how fast the host's time, as it is served, runs from a local time on, s/s: the mean over a span."""
        served = self._known()
        ahead_s = served.offset_at(at_local_s + span_s) - served.offset_at(at_local_s)
        return 1.0 + ahead_s / span_s

    def uncertainty_s(self, at_local_s: float) -> float:
        """Return how far `offset_s` may be from the truth, s; infinite before the first exchange."""
        if self._line is None or self._served is None:
            return math.inf
        return self._line.error_at(at_local_s) + self._served.correction_left_s(at_local_s)

    def error_s(self, at_local_s: float) -> float:
        """Return how far the estimate itself may be from the truth, s, whatever is served meanwhile."""
        return math.inf if self._line is None else self._line.error_at(at_local_s)

    def settle(self, now_s: float, *, is_unused: bool = False) -> None:
        """
        Serve the estimate as it stands, at once; for the moment before anything relies on the clock.

        Exchanges that waited behind a long piece of work may have been far off; what they taught is not
        slewed out of a run that has only just begun. Of several that share the clock the first does this.

        Args:
            now_s: Local clock.
            is_unused: Whether nothing relies on it still, whoever has settled it before.
        """
        if self._line is not None and (is_unused or not self._is_settled):
            self._is_settled = True
            self._served, self._asked_s = None, -math.inf
            self._serve(self._line, now_s, may_jump_ahead=False)

    def to_host_s(self, local_s: float) -> float:
        """
        Return the host's time at a local time, s.

        Raises:
            PeerError: No exchange has come yet.
        """
        served = self._served or self._known()
        if local_s > self._asked_s:
            self._asked_s = local_s
        # As `offset_at` has it, without a call: several times per tick.
        since_s = local_s - served.anchor_s
        slewing_s = served.slewing_s
        if since_s < slewing_s:
            slewing_s = since_s if since_s > 0.0 else 0.0
        return local_s + (served.offset_s + since_s * served.drift + slewing_s * served.slew)

    def to_local_s(self, host_s: float) -> float:
        """
        Return the local time at which the host's clock shows *host_s*: the inverse of `to_host_s`.

        Raises:
            PeerError: No exchange has come yet.
        """
        return self._known().local_at(host_s)

    def _known(self) -> _Served:
        if self._served is None:
            raise PeerError("the host's clock is not known here: no exchange has come back yet")
        return self._served

    def _take(self, sample: _Sample, now_s: float) -> None:
        if self._line is not None and self._contradicts(sample, self._line):
            self._suspects.append(sample)
            if len(self._suspects) < STEP_CONFIRMATIONS:
                return
            self.steps += 1
            self._restart()
            self._line = _fit(self._samples)
            self._serve(self._line, now_s, may_jump_ahead=True)
            return
        self._suspects.clear()
        self._keep(sample)
        self._line = _fit(self._samples)
        self._serve(self._line, now_s, may_jump_ahead=False)

    def _contradicts(self, sample: _Sample, line: _Line) -> bool:
        """Tell whether no queue could explain the exchange: its bounds exclude the estimate's."""
        error_s = abs(sample.offset_s - line.at(sample.local_s))
        slack_s = STEP_UNCERTAINTIES * line.error_at(sample.local_s)
        return error_s > sample.round_trip_s / 2 + slack_s

    def _restart(self) -> None:
        self._samples.clear()
        self._slot_s = SLOT_S_FIRST
        self._slot_began_s = -math.inf
        for suspect in self._suspects:
            self._keep(suspect)
        self._suspects.clear()

    def _keep(self, sample: _Sample) -> None:
        """Let *sample* stand for its slot if its round trip is the shortest there."""
        samples = self._samples
        if samples and sample.local_s < self._slot_began_s + self._slot_s:
            if sample.round_trip_s < samples[-1].round_trip_s:
                samples[-1] = sample
            return
        samples.append(sample)
        self._slot_began_s = sample.local_s
        oldest_s = sample.local_s - SLOTS_MAX * SLOT_S_MAX
        if len(samples) > SLOTS_MAX and self._slot_s < SLOT_S_MAX:
            self._slot_s *= 2
            pairs = zip(samples[0::2], [*samples[1::2], samples[-1]], strict=False)
            samples[:] = [min(pair, key=lambda one: one.round_trip_s) for pair in pairs]
        while len(samples) > SLOTS_MAX or samples[0].local_s < oldest_s:
            del samples[0]

    def _serve(self, line: _Line, now_s: float, *, may_jump_ahead: bool) -> None:
        """Turn the served line towards *line* from now on."""
        # A caller may have asked for a moment after the answer came; what it was told stands.
        anchor_s = max(now_s, min(self._asked_s, now_s + QUERY_AHEAD_S_MAX))
        wanted_s = line.at(anchor_s)
        before = self._served
        self.changes += 1
        offset_s = wanted_s if before is None else before.offset_at(anchor_s)
        correction_s = wanted_s - offset_s
        if self.exchanges <= EXCHANGES_MIN or (may_jump_ahead and correction_s > 0):
            offset_s, correction_s = wanted_s, 0.0
        rate = min(max(abs(correction_s) / SLEW_S, SLEW_MIN), SLEW_MAX)
        self._served = _Served(
            anchor_s=anchor_s,
            offset_s=offset_s,
            drift=line.drift,
            slew=math.copysign(rate, correction_s),
            slewing_s=abs(correction_s) / rate,
        )


def _fit(samples: list[_Sample]) -> _Line:
    """
    Draw the line through the samples, the better the round trip the heavier.

    Drift is drawn towards zero with the weight of a prior, which decides alone while the samples
    span too little time. The errors are bounds, not deviations: all samples may be off to the same
    side by all that their round trips allow.
    """
    shortest_s = min(sample.round_trip_s for sample in samples)
    sigmas = [STAMP_NOISE_S + (sample.round_trip_s - shortest_s) / 2 for sample in samples]
    weights = [1 / (sigma * sigma) for sigma in sigmas]
    line, residual_s = _weighted_line(samples, weights, sigmas)
    if len(samples) > 2 and residual_s > 0:
        # Once more with less weight for what lies far off (Huber): one liar must not tilt the line.
        far_s = 2 * residual_s + STAMP_NOISE_S
        weights = [
            weight * min(1.0, far_s / max(abs(sample.offset_s - line.at(sample.local_s)), far_s))
            for weight, sample in zip(weights, samples, strict=True)
        ]
        line, _ = _weighted_line(samples, weights, sigmas)
    return line


def _weighted_line(
    samples: list[_Sample], weights: list[float], sigmas: list[float]
) -> tuple[_Line, float]:
    """Return the line and the weighted mean of the residuals' sizes, s."""
    total = sum(weights)
    origin = samples[-1]
    centre_s = origin.local_s + (
        sum(w * (s.local_s - origin.local_s) for w, s in zip(weights, samples, strict=True)) / total
    )
    mean_s = origin.offset_s + (
        sum(w * (s.offset_s - origin.offset_s) for w, s in zip(weights, samples, strict=True))
        / total
    )
    prior = 1 / (DRIFT_PRIOR * DRIFT_PRIOR)
    spread = prior
    slope = lean = bound_s = 0.0
    for sample, weight, sigma in zip(samples, weights, sigmas, strict=True):
        lever_s = sample.local_s - centre_s
        pull = weight * lever_s
        spread += pull * lever_s
        slope += pull * (sample.offset_s - mean_s)
        lean += abs(pull) * sigma
        bound_s += weight * sample.round_trip_s
    drift = min(max(slope / spread, -DRIFT_MAX), DRIFT_MAX)
    residual_s = (
        sum(
            weight * abs(sample.offset_s - mean_s - (sample.local_s - centre_s) * drift)
            for sample, weight in zip(samples, weights, strict=True)
        )
        / total
    )
    line = _Line(
        centre_s=centre_s,
        offset_s=mean_s,
        drift=drift,
        offset_error_s=bound_s / total / 2 + residual_s + STAMP_NOISE_S,
        drift_error=min((lean + DRIFT_MAX * prior) / spread, DRIFT_MAX),
        newest_s=samples[-1].local_s,
    )
    return line, residual_s
