"""The agents of a run that are started by hand: each has a line, opened with the run and closed when it is over. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from cosmos_cli.launch.actions import (
    Agenda,
    CloseManualLine,
    OpenManualLine,
    SendOnManualLine,
    StopListening,
)
from cosmos_cli.launch.events import Listening
from cosmos_cli.launch.run_events import ManualAgentJoined

STILL_CONNECTED = "{}, started by hand, is still connected: its line is being closed"


class ManualAgents:
    """
    The lines to these agents, and which of them are connected.

    Args:
        agenda: The supervision's.
    """

    def __init__(self, agenda: Agenda) -> None:
        self._agenda = agenda
        self._is_connected: dict[str, bool] = {}
        self._is_ending = False

    def __len__(self) -> int:
        return len(self._is_connected)

    def open(self, agent: str, machine: str, listening: Listening) -> None:
        """Wait for an agent."""
        self._is_connected[agent] = False
        self._agenda.do(OpenManualLine(agent, machine, listening))

    def joined(self, event: ManualAgentJoined) -> None:
        """Note that an agent has connected."""
        self._is_connected[event.agent] = True

    def left(self, agent: str) -> bool:
        """Note that an agent has gone; True if that was before its time."""
        self._is_connected[agent] = False
        if self._is_ending:
            self._close(agent)
        return not self._is_ending

    def send(self, command: Mapping[str, Any]) -> None:
        """Send all a command."""
        self._agenda.do(*(SendOnManualLine(agent, command) for agent in self._is_connected))

    def end(self, wait_s: float) -> None:
        """Let nobody in any more, and close after *wait_s* the lines of agents that are still connected then."""
        self._is_ending = True
        for agent, is_connected in tuple(self._is_connected.items()):
            self._agenda.do(StopListening(agent))
            if is_connected:
                self._agenda.after(f"manual line {agent}", wait_s, partial(self._abandon, agent))
            else:
                self._close(agent)

    def close(self) -> None:
        """Close all at once."""
        for agent in tuple(self._is_connected):
            self._close(agent)

    def _abandon(self, agent: str) -> None:
        """Close the line of an agent that has not left."""
        self._agenda.problem(STILL_CONNECTED.format(agent))
        self._close(agent)

    def _close(self, agent: str) -> None:
        self._agenda.cancel(f"manual line {agent}")
        del self._is_connected[agent]
        self._agenda.do(CloseManualLine(agent))
