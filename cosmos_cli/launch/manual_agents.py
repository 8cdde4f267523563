"""The agents of a run that are started by hand: each has a seat, opened with the run and closed when it is over. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from cosmos_cli.launch.actions import Agenda, CloseSeat, OpenSeat, SendSeat, StopSeat
from cosmos_cli.launch.events import Listening
from cosmos_cli.launch.run_events import ManualAgentJoined

STILL_CONNECTED = "{}, started by hand, is still connected: its line is being closed"


class ManualAgents:
    """
    The seats and who has taken one.

    Args:
        agenda: The supervision's.
    """

    def __init__(self, agenda: Agenda) -> None:
        self._agenda = agenda
        self._is_taken: dict[str, bool] = {}
        self._is_ending = False

    def __len__(self) -> int:
        return len(self._is_taken)

    def open(self, agent: str, machine: str, listening: Listening) -> None:
        """Open a seat."""
        self._is_taken[agent] = False
        self._agenda.do(OpenSeat(agent, machine, listening))

    def joined(self, event: ManualAgentJoined) -> None:
        """Note that a seat is taken."""
        self._is_taken[event.agent] = True

    def left(self, agent: str) -> bool:
        """Note that a seat is free again; True if that was before its time."""
        self._is_taken[agent] = False
        if self._is_ending:
            self._close(agent)
        return not self._is_ending

    def send(self, command: Mapping[str, Any]) -> None:
        """Send all a command."""
        self._agenda.do(*(SendSeat(agent, command) for agent in self._is_taken))

    def end(self, wait_s: float) -> None:
        """Let nobody in any more, and close after *wait_s* the seat that is still taken then."""
        self._is_ending = True
        for agent, is_taken in tuple(self._is_taken.items()):
            self._agenda.do(StopSeat(agent))
            if is_taken:
                self._agenda.after(f"seat {agent}", wait_s, partial(self._abandon, agent))
            else:
                self._close(agent)

    def close(self) -> None:
        """Close all at once."""
        for agent in tuple(self._is_taken):
            self._close(agent)

    def _abandon(self, agent: str) -> None:
        """Close the seat of an agent that has not left."""
        self._agenda.problem(STILL_CONNECTED.format(agent))
        self._close(agent)

    def _close(self, agent: str) -> None:
        self._agenda.cancel(f"seat {agent}")
        del self._is_taken[agent]
        self._agenda.do(CloseSeat(agent))
