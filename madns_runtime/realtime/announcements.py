"""Events that the host of a run in real time tells its operator, and notes in its own records."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from madns_runtime.plugin.api import HOST
from madns_runtime.protocol.events import AgentMoved
from madns_runtime.protocol.states import HostState
from madns_runtime.recording.run_journal import RunJournal


class Announcements:
    """
    Tells what changes.

    Args:
        journal: The host's.
        emit: Takes an event for the operator.
    """

    def __init__(self, journal: RunJournal, emit: Callable[[Mapping[str, Any]], None]) -> None:
        self._journal = journal
        self._emit = emit

    def state(self, state: HostState) -> None:
        """Tell the host's new state."""
        self._journal.event("state", state=state.value)
        self._emit({"event": "state", "state": state.value})

    def agent_moved(self, event: AgentMoved, *, is_intended: bool = False) -> None:
        """Tell the new phase of an agent; *is_intended* where it is lost on purpose."""
        moved = {
            "agent": event.agent,
            "state": event.phase.value,
            "reason": event.reason,
            "incarnation": event.incarnation,
            **({"is_intended": True} if is_intended else {}),
        }
        self._journal.event("agent", **moved)
        self._emit({"event": "agent", **moved})

    def log(self, level: str, text: str) -> None:
        """Log a sentence, and tell it."""
        self._journal.say(level, text)
        self._emit({"event": "log", "level": level, "source": HOST, "text": text})
