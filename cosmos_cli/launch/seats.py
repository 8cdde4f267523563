"""All seats of hand-started agents of a run: opened with it, and closed when it is over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from cosmos_cli.launch.loop import Loop
from cosmos_cli.launch.manual import ManualSeat
from cosmos_cli.launch.talk import Talk

STILL_CONNECTED = "{}, started by hand, is still connected: its line is being closed"


class Seats:
    """
    The seats.

    Args:
        loop: The operator's.
        on_line: Called with an agent's name and a line that it says.
        on_left: Called with the name of an agent whose connection has ended before its time.
        talk: Where a person is told what to type.
        within_s: How long the run waits for them.
    """

    def __init__(
        self,
        loop: Loop,
        *,
        on_line: Callable[[str, bytes], None],
        on_left: Callable[[str], None],
        talk: Talk,
        within_s: float,
    ) -> None:
        self._loop = loop
        self._on_line = on_line
        self._on_left = on_left
        self._talk = talk
        self._within_s = within_s
        self._seats: dict[str, ManualSeat] = {}
        self._is_ending = False

    def __len__(self) -> int:
        return len(self._seats)

    def open(self, agent: str, launch: Mapping[str, Any]) -> None:
        """Open a seat and say which command takes it."""
        self._seats[agent] = ManualSeat(
            agent,
            self._loop.selector,
            launch=launch,
            on_line=partial(self._on_line, agent),
            on_left=partial(self._left, agent),
        )
        command = self._seats[agent].command()
        text = f"start {agent} by hand within {self._within_s:g} s, in another terminal:"
        self._talk.say(f"{text}\n  {command}", "manual")

    def send(self, command: Mapping[str, Any]) -> None:
        """Send a command to whoever sits."""
        for seat in self._seats.values():
            seat.send(command)

    def end(self, at_s: float) -> None:
        """Let nobody in any more, and close at *at_s* who has not left by then."""
        self._is_ending = True
        for agent, seat in list(self._seats.items()):
            seat.stop_listening()
            if seat.is_taken:
                self._loop.deadlines.set(f"seat {agent}", at_s, partial(self._abandon, agent))
            else:
                self._close(agent)

    def close(self) -> None:
        """Close all at once."""
        for agent in list(self._seats):
            self._close(agent)

    def _left(self, agent: str) -> None:
        if self._is_ending:
            self._close(agent)
        else:
            self._on_left(agent)

    def _abandon(self, agent: str) -> None:
        self._talk.problem(STILL_CONNECTED.format(agent))
        self._close(agent)

    def _close(self, agent: str) -> None:
        self._loop.deadlines.cancel(f"seat {agent}")
        self._seats.pop(agent).close()
