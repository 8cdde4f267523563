"""A machine's clock that steps and drifts on purpose, as the estimate of the host's clock reads it. Pure."""

from __future__ import annotations

from collections import Counter
from typing import Final

from madns_runtime.timing.clocksync import ClockEstimate

PPM: Final = 1e-6


class FaultableClock(ClockEstimate):
    """
    An estimate whose local clock may be put wrong.

    Whoever asks goes on to give, and to be given, times of the real local clock: between it and the estimate lies
    the error of the clock that is put wrong. Exchanges bear that error, too, so that the estimate has to find it.
    """

    def __init__(self) -> None:
        super().__init__()
        self._anchor_s = 0.0
        """Real local time from which the error is counted."""
        self._error_s = 0.0
        """Clock that is put wrong minus the real one, at the anchor."""
        self._rate = 0.0
        """By how much it runs faster."""
        self._rates: dict[int, float] = {}
        self._holders: Counter[int] = Counter()
        """By fault, how many agents of the process it is a fault of."""
        self._steps: set[int] = set()

    def step(self, fault: int, by_s: float, now_s: float) -> bool:
        """Put the clock forward, or back; False if that was done already for another agent of the process."""
        if fault in self._steps:
            return False
        self._steps.add(fault)
        self._settle_error(now_s)
        self._error_s += by_s
        # What was asked before was asked of a clock that showed other times: none of these is still to come.
        self._asked_s = min(self._asked_s, self.wrong_s(now_s))
        return True

    def drift(self, fault: int, ppm: float, now_s: float) -> bool:
        """Let the clock run faster, or slower; False if it does already, by another agent of the process."""
        self._holders[fault] += 1
        if fault in self._rates:
            return False
        self._settle_error(now_s)
        self._rates[fault] = ppm * PPM
        self._rate = sum(self._rates.values())
        return True

    def end_drift(self, fault: int, now_s: float) -> bool:
        """Let it run as it did; what it has gained stays. False while it is a fault of others of the process, too."""
        self._holders[fault] -= 1
        if self._holders[fault] > 0 or fault not in self._rates:
            return False
        self._settle_error(now_s)
        del self._rates[fault]
        self._rate = sum(self._rates.values())
        return True

    def wrong_s(self, local_s: float) -> float:
        """Return what the clock shows at a time of the real local clock, s."""
        return local_s + (self._error_s + (local_s - self._anchor_s) * self._rate)

    def add_exchange(
        self,
        t_sent_s: float,
        t_peer_received_s: float,
        t_peer_sent_s: float,
        t_received_s: float,
    ) -> bool:
        """Take in one exchange as the clock saw it; see `ClockEstimate.add_exchange`."""
        return super().add_exchange(
            self.wrong_s(t_sent_s),
            t_peer_received_s,
            t_peer_sent_s,
            self.wrong_s(t_received_s),
        )

    def offset_s(self, at_local_s: float) -> float:
        """Return the host's clock minus this one, s, as it is served."""
        return super().offset_s(self.wrong_s(at_local_s))

    def rate(self, at_local_s: float, span_s: float) -> float:
        """Return how fast what is taken for the host's time runs against the real local clock, s/s."""
        return super().rate(self.wrong_s(at_local_s), span_s) * (1.0 + self._rate)

    def uncertainty_s(self, at_local_s: float) -> float:
        """Return how far `offset_s` may be from the truth, s, as far as the estimate knows."""
        return super().uncertainty_s(self.wrong_s(at_local_s))

    def error_s(self, at_local_s: float) -> float:
        """Return how far the estimate may be from the truth, s, as far as it knows."""
        return super().error_s(self.wrong_s(at_local_s))

    def settle(self, now_s: float, *, is_unused: bool = False) -> None:
        """Serve the estimate as it stands, at once."""
        super().settle(self.wrong_s(now_s), is_unused=is_unused)

    def _to_host_s_when_wrong(self, local_s: float) -> float:
        """Return what is taken for the host's time, s."""
        return super().to_host_s(self.wrong_s(local_s))

    def to_local_s(self, host_s: float) -> float:
        """Return the real local time at which the host's clock is taken to show *host_s*."""
        ahead_s = super().to_local_s(host_s) - self._error_s - self._anchor_s
        return self._anchor_s + ahead_s / (1.0 + self._rate)

    def _settle_error(self, now_s: float) -> None:
        # Only from now on, in the place of the method: a right clock is read often, without a layer between.
        self.to_host_s = self._to_host_s_when_wrong  # type: ignore[method-assign]  # meant: see above
        self._error_s += (now_s - self._anchor_s) * self._rate
        self._anchor_s = now_s
        self.changes += 1
