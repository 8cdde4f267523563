"""The host's side of conditions: notes that one is met, and calls whoever waits for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from madns_runtime.conditions.condition import HOST, Condition
from madns_runtime.conditions.tap import ConditionTap

T_S_DIGITS = 6
BROKEN = "broken"
"""Status of a run that ended with an expectation that was broken."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MetCondition:
    """A condition that is met."""

    condition: Condition
    agent: str
    """Source of the record: an agent's name, or `host`."""
    t_s: float
    """Simulated time of it, s."""
    heard_s: float
    """Simulated time at which the host heard of it, s."""

    @property
    def delay_s(self) -> float:
        """How much later the host heard of it, s."""
        return max(0.0, self.heard_s - self.t_s)


def ending_of(met: MetCondition) -> tuple[str, str]:
    """Return who ends a run over a condition that is met, and why."""
    return met.agent, f"expectation {met.condition.name} is broken at t = {met.t_s:g} s"


class NotesEvents(Protocol):
    """A run's journal."""

    def event(self, event: str, **values: object) -> None:
        """Record that something happened now."""


OnMet = Callable[[MetCondition], None]


def _do_nothing() -> None:
    """Heed nothing."""


class HostConditions:
    """
    The host's side of the run's conditions: those on the records of its own half, and what agents report of theirs.

    Each that is met is noted in the host's events and given to those who wait for it: when `settle` is called, in
    the order in which word of them came, so that a run in lockstep acts at the end of a tick.

    Args:
        conditions: All of the run.
        tick_hz: Rate of agents' ticks.
        now_s: Returns the simulated time, s.
        end: Ends the run, given over whose record, why and with which status: an expectation is broken.
        on_heard: Called when there is something to settle.
    """

    def __init__(
        self,
        conditions: Sequence[Condition],
        *,
        tick_hz: float,
        now_s: Callable[[], float],
        end: Callable[[str, str, str], None],
        on_heard: Callable[[], None] = _do_nothing,
    ) -> None:
        self._conditions = {each.number: each for each in conditions}
        self._now_s = now_s
        self._end = end
        self._on_heard = on_heard
        self._waiting: dict[int, list[OnMet]] = {}
        self._heard: list[MetCondition] = []
        self.tap = ConditionTap(
            HOST,
            conditions,
            tick_hz=tick_hz,
            now_s=now_s,
            report=lambda number, agent, t_s: self.hear(agent, number, t_s),
        )
        """For the recorder of the host's half."""
        self.end_s = math.inf
        """Simulated time at which the run ends anyway, s: a check that is broken behind it ends nothing, and is judged as ever."""
        self.unknown_count = 0
        """Reports of conditions that the run does not have: messages that nobody can have meant."""

    def on_met(self, number: int, call: OnMet) -> None:
        """Have *call* called each time that an agent, or the host's half, meets the condition of this number."""
        self._waiting.setdefault(number, []).append(call)

    def hear(self, agent: str, number: int, t_s: float) -> None:
        """Take word that a record of *agent* met the condition of this number, at simulated time *t_s*, s."""
        condition = self._conditions.get(number)
        if condition is None:
            self.unknown_count += 1
            return
        heard_s = self._now_s()
        met = MetCondition(condition=condition, agent=agent, t_s=t_s, heard_s=heard_s)
        self._heard.append(met)
        self._on_heard()

    def settle(self, journal: NotesEvents) -> None:
        """Note in *journal* what was heard, and act on it."""
        while self._heard:
            met = self._heard.pop(0)
            journal.event(
                "condition_met",
                condition=met.condition.name,
                agent=met.agent,
                met_s=round(met.t_s, T_S_DIGITS),
                delay_s=round(met.delay_s, T_S_DIGITS),
            )
            for call in self._waiting.get(met.condition.number, ()):
                call(met)
            if met.condition.ends_run and met.heard_s <= self.end_s:
                self._end(*ending_of(met), BROKEN)
