"""The clocks: monotonic seconds for everything that acts, wall time for records alone."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock; its zero means nothing."""

    def now_s(self) -> float:
        """Return the present time, s."""


class ManualClock:
    """
    A clock that moves when it is told to, for tests.

    Args:
        now_s: Where it stands at first, s.
    """

    def __init__(self, now_s: float = 0.0) -> None:
        self._now_s = now_s

    def now_s(self) -> float:
        """Return the present time, s."""
        return self._now_s

    def advance(self, step_s: float) -> float:
        """
        Move on by *step_s* and return the new time, s.

        Raises:
            ValueError: The step is negative; a monotonic clock has none.
        """
        if step_s < 0:
            raise ValueError(f"a monotonic clock cannot go back by {-step_s:g} s")
        self._now_s += step_s
        return self._now_s


def utc_now_iso() -> str:
    """Return the wall time as ISO 8601 in UTC with microseconds and Z; for records, never for deadlines."""
    return utc_at_iso(0.0)


def utc_at_iso(in_s: float) -> str:
    """Return the wall time *in_s* seconds from now (negative: ago) in the form of `utc_now_iso`."""
    utc = datetime.now(UTC) + timedelta(seconds=in_s)
    return utc.isoformat(timespec="microseconds").replace("+00:00", "Z")
