"""Losses of agents that faults cause on purpose: ordered, come true, and gone back on. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

RETURN_S_MIN: Final = 0.2
"""Least time from an agent's end by a fault to its return, s."""
RETURN_S_MAX: Final = 5.0
"""Time that a return may take beyond its moment, s of simulated time: a process starts and sets itself up."""


@dataclass(slots=True)
class _Absence:
    """The newest ordered loss of one agent."""

    why: str
    returns_s: float | None
    """Simulated time of its return, s; None for never."""
    is_awaited: bool = True
    """Whether the loss has still to come true."""
    is_away: bool = True
    incarnations: list[int] = field(default_factory=list)
    """Those that were ended on purpose, from 1, of all absences."""


class IntendedLosses:
    """The losses that were ordered in one run."""

    def __init__(self) -> None:
        self._absences: dict[str, _Absence] = {}
        self._as_good_as_lost: set[str] = set()

    def order(self, agent: str, why: str, *, returns_s: float | None) -> None:
        """
        Note that an agent is to be lost now.

        Args:
            agent: Its name.
            why: In words, for people.
            returns_s: Simulated time of its return, s; None for never.
        """
        before = self._absences.get(agent)
        kept = before.incarnations if before else []
        self._absences[agent] = _Absence(why, returns_s, incarnations=kept)

    def note(self, agents: Iterable[str]) -> None:
        """Note that agents are as good as lost by an action of their simulation; they go on and are judged as ever."""
        self._as_good_as_lost.update(agents)

    def take(self, agent: str, incarnation: int) -> str | None:
        """
        Note that an agent is lost.

        Args:
            agent: Its name.
            incarnation: Which of its starts has ended, from 1.

        Returns:
            Why, if this loss was ordered; None if it was not, and is to be judged.
        """
        absence = self._absences.get(agent)
        if absence is None or not absence.is_awaited:
            return None
        absence.is_awaited = False
        absence.incarnations.append(incarnation)
        return absence.why

    def is_coming(self, agent: str) -> bool:
        """Tell whether a loss of an agent was ordered that has still to come true."""
        absence = self._absences.get(agent)
        return absence is not None and absence.is_awaited

    def returned(self, agent: str) -> None:
        """Note that an agent is back; a loss that was ordered of it meanwhile has still to come true."""
        absence = self._absences.get(agent)
        if absence is not None and not absence.is_awaited:
            absence.is_away = False

    def returns_s(self, agent: str) -> float | None:
        """Return the simulated time at which a lost agent is to return, s; None if it is not."""
        absence = self._absences.get(agent)
        return absence.returns_s if absence is not None and absence.is_away else None

    def are_expected(self, is_in_time: Callable[[str, float], bool]) -> bool:
        """
        Tell whether an agent is still to return.

        Args:
            is_in_time: Tells of an agent and the simulated time of its return, s, whether that is soon enough.
        """
        return any(
            absence.is_away
            and absence.returns_s is not None
            and is_in_time(agent, absence.returns_s)
            for agent, absence in self._absences.items()
        )

    def overdue(self, t_s: float, patience_s: float = RETURN_S_MAX) -> dict[str, str]:
        """Return the agents that should have been back by *t_s*, s of simulated time, with the reason in words."""
        return {
            agent: f"{absence.why}; it was to return at t = {absence.returns_s:g} s and did not"
            for agent, absence in self._absences.items()
            if absence.is_away
            and absence.returns_s is not None
            and absence.returns_s + patience_s < t_s
        }

    def names(self) -> list[str]:
        """Return the agents that were lost on purpose, also those that came back, sorted."""
        lost = {agent for agent, each in self._absences.items() if each.incarnations}
        return sorted(lost | self._as_good_as_lost)

    def incarnations(self, agent: str) -> list[int]:
        """Return which of an agent's starts were ended on purpose, from 1."""
        absence = self._absences.get(agent)
        return list(absence.incarnations) if absence is not None else []


def of_intended(losses: IntendedLosses, agent: str) -> dict[str, Any]:
    """Return what an agent's part of a result tells of its ordered losses: nothing without one."""
    ended = losses.incarnations(agent)
    return {"ended_on_purpose": ended} if ended else {}
