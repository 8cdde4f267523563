"""When the host answers, and until an agent's packet shows that the answer arrived: its own round trips. Pure."""

from __future__ import annotations

import math

PENDING_MAX = 1024
"""Answers to one agent of which nothing is heard yet; the oldest beyond that counts as not seen."""


def ahead_of(agents: int) -> float:
    """Return by what share of its period the host's tick comes before the period's end: between two agents' ticks, not at one's."""
    return 0.5 / agents


def last_answer_s(end_s: float, answer_hz: float, agents: int) -> float:
    """Return the simulated time of the host's last tick by *end_s*, s."""
    ahead = ahead_of(agents)
    return (math.floor(end_s * answer_hz + ahead) - ahead) / answer_hz


class AnswerTimes:
    """Times of answers by agent and packet, in the order in which they were sent."""

    def __init__(self) -> None:
        self._pending: dict[str, dict[int, float]] = {}
        self.not_seen = 0
        """Answers that were overtaken by a later one: lost, or read in the same tick as that."""

    def answered(self, agent: str, packet: int, now_s: float) -> None:
        """Take down that an answer to *packet* leaves now."""
        pending = self._pending.setdefault(agent, {})
        if len(pending) >= PENDING_MAX:
            del pending[next(iter(pending))]
            self.not_seen += 1
        pending[packet] = now_s

    def seen(self, agent: str, packet: int) -> float | None:
        """
        Return when the answer to *packet* left, which the agent says is the newest that it has; None if it said so before.

        Older answers are of no more interest then.
        """
        pending = self._pending.get(agent)
        if pending is None or packet not in pending:
            return None
        sent_s = pending.pop(packet)
        for older in [each for each in pending if each < packet]:
            del pending[older]
            self.not_seen += 1
        return sent_s
