"""From the word of an action to its handler; each begin, end and refusal is recorded as an event. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from madns_runtime.timeline.action import ActionHandler, ActionRefused, TimelineAction

BEGAN: Final = "action_began"
ENDED: Final = "action_ended"
REFUSED: Final = "action_refused"
RESUMED: Final = "action_resumed"
T_S_DIGITS: Final = 6
Resume = Callable[[TimelineAction, str], None]
"""Lets an action that is in force take place anew at an agent that has returned."""
_NOTHING: Final[Mapping[str, Resume]] = MappingProxyType({})


class Dispatcher:
    """
    Hands actions to their handlers.

    Args:
        handlers: By word. A word without one is refused: the time mode does not have it.
        record: Records an event, given its name and values.
        resume: By word, of actions whose effect ends with their agent.
        returned: Told of each agent that has returned, before what is in force goes on there.
    """

    def __init__(
        self,
        handlers: Mapping[str, ActionHandler],
        record: Callable[..., None],
        resume: Mapping[str, Resume] = _NOTHING,
        *,
        returned: Callable[[str], None] = lambda agent: None,
    ) -> None:
        self._handlers = handlers
        self._record = record
        self._resume = resume
        self._returned = returned
        self._in_force: dict[int, TimelineAction] = {}

    @property
    def in_force(self) -> tuple[TimelineAction, ...]:
        """The actions that have begun and have an end to come, or none before the run's."""
        return tuple(self._in_force.values())

    def begin(self, action: TimelineAction, now_s: float, *, lasts: bool) -> str:
        """
        Begin an action; return why it is refused, "" if it takes place.

        Args:
            action: Due at its t_s.
            now_s: Simulated time, s: the delay is recorded.
            lasts: Whether it is in force from now on.
        """
        handler = self._handlers.get(action.word)
        try:
            if handler is None:
                raise ActionRefused(f"there is no action {action.word!r} in this run")
            absent = handler.begin(action)
        except ActionRefused as refusal:
            self._record(REFUSED, **described(action, now_s), reason=str(refusal))
            return str(refusal)
        values = described(action, now_s)
        self._record(BEGAN, **values, for_s=action.for_s, lasts=lasts, **_told_absent(absent))
        if lasts:
            self._in_force[action.number] = action
        return ""

    def resume(self, agent: str) -> None:
        """Let what is in force go on at an agent that has returned: what it was told is gone with its former start."""
        self._returned(agent)
        for action in self.in_force:
            if agent in action.agents and (resume := self._resume.get(action.word)) is not None:
                resume(action, agent)
                self._record(RESUMED, number=action.number, action=action.word, agent=agent)

    def end(self, action: TimelineAction, due_s: float, now_s: float) -> str:
        """End one that is in force, due at *due_s*; return why that was refused, or ""."""
        if self._in_force.pop(action.number, None) is None:
            return f"{action.word} is not in force"
        values = described(action, now_s, due_s)
        try:
            absent = self._handlers[action.word].end(action)
        except ActionRefused as refusal:
            self._record(REFUSED, **values, reason=f"to end: {refusal}")
            return str(refusal)
        self._record(ENDED, **values, **_told_absent(absent))
        return ""


def _told_absent(agents: Sequence[str] | None) -> dict[str, list[str]]:
    return {"not_there": list(agents)} if agents else {}


def described(action: TimelineAction, now_s: float, due_s: float | None = None) -> dict[str, Any]:
    """Return the values by which an event tells of an action at *now_s*, due at *due_s* or at its begin."""
    due_s = action.t_s if due_s is None else due_s
    return {
        "number": action.number,
        "action": action.word,
        "agents": list(action.agents),
        "parameters": dict(action.parameters),
        "due_s": round(due_s, T_S_DIGITS),
        "delay_s": round(now_s - due_s, T_S_DIGITS),
    }
