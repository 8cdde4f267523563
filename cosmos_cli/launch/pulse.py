"""
Signs of life of one process on another machine: pings that it answers. Pure; the caller has the clock.

Only what was asked and not answered counts as silence, so that an operator that was itself stopped
for a while blames nobody.
"""

from __future__ import annotations

from collections import deque

PING_INTERVAL_S = 1.0
SILENCE_S = 2.5
"""Who says nothing for this long is lost."""
SLOW_S = 1.5
"""An answer that took this long is worth a warning."""
UNANSWERED_MAX = 64


class Pulse:
    """What was asked of one process, and when it was last heard."""

    def __init__(self) -> None:
        self._number = 0
        self._asked_s = float("-inf")
        self._heard_s: float | None = None
        self._unanswered: deque[tuple[int, float]] = deque(maxlen=UNANSWERED_MAX)

    @property
    def was_heard(self) -> bool:
        """Whether it has answered at all: before, it may still be starting."""
        return self._heard_s is not None

    def is_due(self, now_s: float) -> bool:
        """Tell whether it is time to ask again."""
        return now_s - self._asked_s >= PING_INTERVAL_S

    def ping(self, now_s: float) -> int:
        """Note a question and return its number."""
        self._number += 1
        self._asked_s = now_s
        self._unanswered.append((self._number, now_s))
        return self._number

    def pong(self, number: int, now_s: float) -> float:
        """Note the answer to question *number*, and to all before it; return how long the oldest took, s."""
        if self._heard_s is None:
            self._unanswered.clear()  # they waited for the process to start
        self._heard_s = now_s
        took_s = 0.0
        while self._unanswered and self._unanswered[0][0] <= number:
            took_s = max(took_s, now_s - self._unanswered.popleft()[1])
        return took_s

    def silent_s(self, now_s: float) -> float:
        """Return for how long it has said nothing although it was asked; 0 while it starts."""
        if self._heard_s is None or not self._unanswered:
            return 0.0
        waited_s = now_s - self._unanswered[0][1]
        return min(now_s - self._heard_s, waited_s + PING_INTERVAL_S)

    def is_lost(self, now_s: float) -> bool:
        """Tell whether it has been silent for too long."""
        return self.silent_s(now_s) >= SILENCE_S
