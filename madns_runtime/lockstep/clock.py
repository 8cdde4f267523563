"""Simulated time, the only time that anything recorded in lockstep may depend on."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

T0 = datetime(1970, 1, 1, tzinfo=UTC)
"""Wall time of simulated time zero in records, so that two runs of one seed have the same bytes."""
T0_UTC = "1970-01-01T00:00:00.000000Z"


class SimulatedClock:
    """
    The present simulated time; it stands still until it is set.

    Args:
        t_s: Where it stands at first, s: negative before the run.
    """

    __slots__ = ("t_s",)

    def __init__(self, t_s: float) -> None:
        self.t_s = t_s

    def now_s(self) -> float:
        """Return the simulated time, s."""
        return self.t_s

    def utc(self) -> str:
        """Return the simulated time as if it had begun at T0, in ISO 8601."""
        return (T0 + timedelta(seconds=self.t_s)).isoformat(timespec="microseconds")[:-6] + "Z"
